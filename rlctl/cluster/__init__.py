"""Where trainings and cells of robustness maps are executed: on this machine, on SLURM, or on Ray."""
