"""Policy files, and policies that act; NumPy, no torch but in `torch_policy`."""
