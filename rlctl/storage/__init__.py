"""Files: atomic writing, tables, YAML, and reading what others may have written."""
