import gym  # the package that Gymnasium came from, which is not installed


class Pushed(gym.Env):
    pass
