"""What is wrong with a training, as far as its run folder shows it: Q1 to Q13, each with its evidence and what to try.

One sign alone means little: in a perfect training of `reach`, `approx_kl > 0.03` holds for three of four updates. So a
finding needs several signs together; which ones, and all texts, are data in `findings.yaml`.
"""

from rlctl.runs.diagnosis.findings import Finding, Grade, diagnose, explain, format_end, format_finding

__all__ = ["Finding", "Grade", "diagnose", "explain", "format_end", "format_finding"]
