"""The experiments that several rules share: they record for judges in the parent process, or have hooks for rules.

An experiment of one rule is in the rule's file. How both are written is in the package `rules`.
"""
