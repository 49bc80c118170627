"""Policy files, and policies that act with NumPy. Only `torch_policy` imports torch."""
