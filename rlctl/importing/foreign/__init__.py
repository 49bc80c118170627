"""Policies of other projects: files that describe how they are deployed, and networks, read as data."""
