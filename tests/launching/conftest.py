"""Trainings of the tests of `rlctl.training`."""

from tests.training.conftest import resume as resume
from tests.training.conftest import train as train
