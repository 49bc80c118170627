"""Policies and runs at addresses: `hf://ORG/NAME`, `s3://BUCKET/NAME`, any scheme of fsspec."""
