"""TensorBoard's files: a step is shown once, and a disk that does not take them costs a warning."""

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from rlctl.training.metrics import make_logger
from tests.training.conftest import TINY


def log(logger, values):
    for step, value in values.items():
        logger.record("loss", value)
        logger.record("time", 1.0, exclude="tensorboard")
        logger.dump(step)
    logger.close()


def test_a_resumed_training_shows_each_step_once(tmp_path):
    log(make_logger(tmp_path, print), {10: 1.0, 20: 2.0, 30: 3.0})
    log(make_logger(tmp_path, print, resumed_at=20), {30: 5.0, 40: 6.0})
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    assert events.Tags()["scalars"] == ["loss"]
    assert [(each.step, each.value) for each in events.Scalars("loss")] == [(10, 1.0), (20, 2.0), (30, 5.0), (40, 6.0)]


def test_a_folder_that_cannot_be_written(tmp_path):
    warnings = []
    (tmp_path / "file").touch()
    logger = make_logger(tmp_path / "file" / "tensorboard", warnings.append)
    log(logger, {10: 1.0, 20: 2.0})
    assert warnings == ["warning: not saved: TensorBoard log: Not a directory; metrics.csv has the same numbers"]
    (tmp_path / "file").unlink()
    log(logger, {30: 3.0})
    assert len(list((tmp_path / "file" / "tensorboard").iterdir())) == 1


def test_runs_are_compared_by_their_hyperparameters(train):
    settings = {**TINY, "algo_kwargs": {**TINY["algo_kwargs"], "learning_rate": "lin_1e-3"}}
    run = train("Line", settings).run
    events = EventAccumulator(str(run.tensorboard))
    events.Reload()
    content = events.SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    values = {
        name: value.string_value or value.number_value
        for name, value in HParamsPluginData.FromString(content).session_start_info.hparams.items()
    }
    assert (values["algo"], values["learning_rate"], values["n_steps"]) == ("ppo", "lin_1e-3", 16)
    assert {"eval/mean_reward", "eval/mean_ep_length"} <= set(events.Tags()["scalars"])
