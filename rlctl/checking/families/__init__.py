"""The code of rules that have no file in the package `rules` yet, by family."""
