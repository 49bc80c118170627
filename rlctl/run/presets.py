"""Recipes that `--config` finds by name: `--config presets/ppo`."""

from __future__ import annotations

from pathlib import Path

from rlctl.errors import ArtifactError, did_you_mean

FOLDER = Path(__file__).with_name("presets")


def list_presets() -> list[str]:
    """Return the names that `--config` knows: `presets/ppo`, and so on."""
    return sorted(f"presets/{file.stem}" for file in FOLDER.glob("*.yaml"))


def find_config(config: Path) -> Path:
    """Return the file of a `--config`: a preset's where no file has that name, else the path itself.

    Raises `ArtifactError` for a preset that does not exist.
    """
    if config.exists() or len(config.parts) != 2 or config.parts[0] != FOLDER.name or config.suffix:
        return config
    file = FOLDER / f"{config.name}.yaml"
    if not file.exists():
        presets = list_presets()
        raise ArtifactError(
            f"no preset {str(config)!r}.{did_you_mean(str(config), presets)} There are: {', '.join(presets)}."
        )
    return file
