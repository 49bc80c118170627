"""`check-env --audit`: who earns most? Scripted competitors play against the wanted behaviour before any training.

`competitors.py` is the table of all that play, `play_world.py` the world that they play in, `walking.py` and
`reaching.py` what the engine moves in it, `child.py` what a child process plays, `ranking.py` the verdict, `audit.py`
all of it, and `report.py` the table.
"""

FORMAT = "rlctl check-env audit 1"
"""The format of the result as JSON."""
