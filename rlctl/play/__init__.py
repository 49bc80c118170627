"""Many environments, fast and reproducible; numpy only."""
