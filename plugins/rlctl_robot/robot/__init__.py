"""A robot in simulation against which a user's own control program is tested."""
