"""Files on disk: names, formats, atomic writes."""
