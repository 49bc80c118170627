"""What trainings leave: the folder of a run, its lock, how runs are found, listed and judged; `report`, `compare`."""
