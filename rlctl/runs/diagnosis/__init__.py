"""The diagnosis of a training from its run folder: findings Q1 to Q13, each with its evidence and what to try.

A single sign proves little: in a perfect training of `reach`, three of four updates have `approx_kl > 0.03`. So a
finding is a combination of signs; `findings.yaml` has the combinations and all texts.
"""

from rlctl.runs.diagnosis.findings import Finding, Grade, diagnose, explain, format_end, format_finding

__all__ = ["Finding", "Grade", "diagnose", "explain", "format_end", "format_finding"]
