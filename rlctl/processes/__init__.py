"""One watched child process."""
