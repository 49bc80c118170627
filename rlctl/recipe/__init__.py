"""How to train a task: typed YAML."""
