"""A task that fails while it is played."""

from rlctl_manipulation.reach import Reach


class Breaks(Reach):
    """Raises after half a second."""

    def is_terminated(self) -> bool:
        """It raises late."""
        self.steps = getattr(self, "steps", 0) + 1
        if self.steps > 10:
            raise ValueError("it broke")
        return False
