"""What is measured: `make bench`, or `python -m tests.benchmarks step reset --repeat 5`."""
