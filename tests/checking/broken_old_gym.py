import gym  # the package that Gymnasium came from, which is not installed


class RL008Pushed(gym.Env):
    pass
