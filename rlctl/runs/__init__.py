"""`rlctl runs` and `rlctl push`: list, show, diagnose, compare, report, remove and upload runs."""
