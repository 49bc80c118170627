"""`rlctl tune`: find hyperparameters for a task with Optuna, and keep what was tried."""
