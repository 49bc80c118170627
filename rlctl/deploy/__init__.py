"""What comes after export: a safety filter, and a server that policies act through. NumPy, no torch."""

from rlctl.deploy.filter.limits import Limits, read_limits
from rlctl.deploy.filter.safety_events import SafetyEvent
from rlctl.deploy.filter.safety_filter import SafetyFilter

__all__ = ["Limits", "SafetyEvent", "SafetyFilter", "read_limits"]
