"""`rlctl runs report`: the results of trainings as one file."""
