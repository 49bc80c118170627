"""Callbacks of Stable-Baselines3, as a user configures them in functions, and two of the user's own."""

from stable_baselines3.common import callbacks
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from tests.training.envs import Line


def make_env():
    return VecNormalize(DummyVecEnv([lambda: Monitor(Line())]), training=False, norm_reward=False)


def evaluation(folder):
    return callbacks.EvalCallback(
        make_env(),
        eval_freq=8,
        n_eval_episodes=1,
        log_path=folder,
        verbose=0,
        callback_on_new_best=callbacks.StopTrainingOnRewardThreshold(1e9),
        callback_after_eval=callbacks.StopTrainingOnNoModelImprovement(1000),
    )


def several(folder):
    every = callbacks.EveryNTimesteps(100, callbacks.CheckpointCallback(1, folder, "every"))
    return callbacks.CallbackList([every, callbacks.CheckpointCallback(24, folder), callbacks.ProgressBarCallback()])


def convert():
    return callbacks.ConvertCallback(lambda names, _: names["self"].num_timesteps < 90)


class Worst(callbacks.BaseCallback):
    """Reads what public callbacks read: the infos, the episodes' buffer, the loop's variables."""

    def __init__(self):
        super().__init__()
        self.returns, self.worst, self.checked = [], 0.0, 0

    def _on_step(self):
        assert self.locals["rewards"].shape == self.locals["dones"].shape == (4,)
        assert len(self.locals["infos"]) == len(self.locals["new_obs"]) == self.training_env.num_envs
        for done, info in zip(self.locals["dones"], self.locals["infos"], strict=True):
            assert done == ("episode" in info) == ("terminal_observation" in info)
            self.returns += [info["episode"]["r"]] if done else []
        self.checked += 1
        self.worst = min([self.worst, *(episode["r"] for episode in self.model.ep_info_buffer)])
        self.logger.record("own/worst", self.worst)
        return True

    def _on_rollout_end(self):
        if hasattr(self.model, "rollout_buffer"):
            self.model.ent_coef = 0.001 * len(self.returns)

    def _on_training_end(self):
        print("checked", self.checked, "steps", self.num_timesteps, "worst", self.worst, self.model.ent_coef)


class NewSchedule(callbacks.BaseCallback):
    def _on_step(self):
        self.model.lr_schedule = lambda _: 1e-4
        return self.num_timesteps < 128


class ReachesIn(callbacks.BaseCallback):
    def _on_step(self):
        self.training_env.env_method("set_wind", 1.0)
        return True
