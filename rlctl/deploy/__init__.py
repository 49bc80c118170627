"""What comes after export: a safety filter, and a server that policies act through. NumPy, no torch."""

from rlctl.deploy.limits import Limits, read_limits
from rlctl.deploy.safety_filter import SafetyEvent, SafetyFilter

__all__ = ["Limits", "SafetyEvent", "SafetyFilter", "read_limits"]
