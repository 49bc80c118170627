"""What happens to files on a disk: a bit flips, the end is gone, a page is zero, a file is gone, or two are swapped."""

import dataclasses
import random
from collections.abc import Callable
from pathlib import Path

PAGE = 4096


def flip(file: Path, chance: random.Random) -> None:
    content = bytearray(file.read_bytes())
    bit = chance.randrange(8 * len(content))
    content[bit // 8] ^= 1 << bit % 8
    file.write_bytes(content)


def truncate(file: Path, chance: random.Random) -> None:
    content = file.read_bytes()
    file.write_bytes(content[: chance.randrange(len(content))])


def zero(file: Path, chance: random.Random) -> None:
    content = bytearray(file.read_bytes())
    start = chance.randrange(len(content)) // PAGE * PAGE
    page = content[start : start + PAGE]
    content[start : start + PAGE] = bytes(len(page))
    file.write_bytes(content)


def remove(file: Path, chance: random.Random) -> None:
    file.unlink()


WAYS: dict[str, Callable[[Path, random.Random], None]] = {
    "flip": flip, "truncate": truncate, "zero": zero, "remove": remove,
}  # fmt: skip

SWAPS = [
    ("checkpoints/{old}/state.json", "checkpoints/{new}/state.json"),
    ("checkpoints/{old}/state.safetensors", "checkpoints/{new}/state.safetensors"),
    ("checkpoints/{old}/policy.safetensors", "checkpoints/{new}/policy.safetensors"),
    ("checkpoints/{new}/policy.safetensors", "policies/best.safetensors"),
    ("policies/last.safetensors", "policies/best.safetensors"),
    ("checkpoints/{new}/state.safetensors", "checkpoints/{new}/policy.safetensors"),
    ("metrics.csv", "evals.csv"),
    ("run.json", "recipe.yaml"),
    ("checkpoints/{old}", "checkpoints/{new}"),
    ("{first segment}", "{last segment}"),
    ("{first episode}", "{last episode}"),
]


def swap(one: Path, other: Path) -> None:
    aside = one.with_name("aside")
    one.rename(aside)
    other.rename(one)
    aside.rename(other)


@dataclasses.dataclass(frozen=True)
class Damage:
    """One thing that happens to a run folder."""

    way: str
    files: tuple[str, ...]
    """Paths below the run folder."""
    number: int
    """Decides where in the file."""

    def do(self, run: Path) -> None:
        if self.way == "swap":
            swap(*(run / file for file in self.files))
        else:
            WAYS[self.way](run / self.files[0], random.Random(self.number))


def all_damage(run: Path, count: int) -> list[Damage]:
    """Return `count` damages to a run: each way to each file in turn, flips more often, and all swaps."""
    files = sorted(str(file.relative_to(run)) for file in run.rglob("*") if file.is_file() and file.stat().st_size)
    damages = [Damage("swap", names, 0) for names in _swaps(run)]
    ways = ["flip", "flip", "truncate", "zero", "flip", "remove"]
    while len(damages) < count:
        number = len(damages)
        # Both lists in turn would give each file the same ways always.
        file = files[number % len(files)]
        damages.append(Damage(ways[(number // len(files) + number) % len(ways)], (file,), number))
    return damages


def _swaps(run: Path) -> list[tuple[str, ...]]:
    checkpoints = sorted(each.name for each in (run / "checkpoints").glob("0*"))
    episodes = sorted(each.name for each in (run / "episodes").glob("*.npz"))
    segments = sorted(each.name for each in (run / "checkpoints" / "replay").glob("*.safetensors"))
    names = {"old": checkpoints[-2], "new": checkpoints[-1]}
    for kind, found, folder in (("episode", episodes, "episodes"), ("segment", segments, "checkpoints/replay")):
        if len(found) > 1:
            names |= {f"first {kind}": f"{folder}/{found[0]}", f"last {kind}": f"{folder}/{found[-1]}"}
    # A run of an on-policy algorithm has no segments.
    known = [pair for pair in SWAPS if len(segments) > 1 or "segment" not in pair[0]]
    return [tuple(each.format(**names) for each in pair) for pair in known]
