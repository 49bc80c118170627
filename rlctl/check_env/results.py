"""What the study of worlds finds out."""

from rlctl.check_env.world_results import Worlds as Worlds
