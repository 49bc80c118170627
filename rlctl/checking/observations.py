"""Recorded observations as the rules about them read them."""


def name_moment(step: int) -> str:
    """Return when an observation was made, in words; 0 is the one of `reset`."""
    return "from reset" if step == 0 else f"at step {step}"
