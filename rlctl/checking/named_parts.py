"""Parts of a robot whose name contradicts what the source calls them, and lists that name one part twice."""

import ast
import functools
import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence

from rlctl.checking.assignments import read_name
from rlctl.checking.bullet_worlds import read_world
from rlctl.checking.experiments.expressions import NotedEpisodes
from rlctl.checking.rule import Rule, RuleFinding
from rlctl.checking.source_code import write_code
from rlctl.checking.term_names import split_name
from rlctl.checking.worlds import WorldBody
from rlctl.environments.simulations import find_mujoco

LEFT, RIGHT, FRONT, REAR = "left", "right", "front", "rear"
SIDES = {
    "left": {LEFT}, "right": {RIGHT}, "l": {LEFT}, "r": {RIGHT}, "front": {FRONT}, "rear": {REAR}, "hind": {REAR},
    "back": {REAR}, "fl": {FRONT, LEFT}, "fr": {FRONT, RIGHT}, "rl": {REAR, LEFT}, "rr": {REAR, RIGHT},
    "bl": {REAR, LEFT}, "br": {REAR, RIGHT}, "hl": {REAR, LEFT}, "hr": {REAR, RIGHT}, "lf": {FRONT, LEFT},
    "rf": {FRONT, RIGHT}, "lh": {REAR, LEFT}, "rh": {REAR, RIGHT},
}  # fmt: skip
OPPOSITES = ((LEFT, RIGHT), (FRONT, REAR))
PARTS = {
    "ankle", "calf", "elbow", "finger", "foot", "gripper", "hand", "handle", "head", "hip", "knee", "shin", "shoulder",
    "sole", "tail", "thigh", "thumb", "torso", "trunk", "wheel", "wrist",
}  # fmt: skip
PLURALS = {"feet": "foot", "calves": "calf", "thighs": "thigh", **{f"{part}s": part for part in PARTS}}
RELATED = {"parent", "parents", "opposite", "other", "mirror", "mirrored", "partner", "attach", "attached", "to", "and"}
"""Words of a name that tells of a relation between parts, or of several."""
NUMBER_WORDS = {"link", "joint", "index", "idx", "id"}
MOST_TRANSPARENT = 8
COUNTS = {"body": "nbody", "geom": "ngeom", "site": "nsite", "joint": "njnt", "actuator": "nu", "sensor": "nsensor"}


def find_named_otherwise(rule: Rule, noted: NotedEpisodes) -> Iterator[RuleFinding]:
    """Yield what is called otherwise than the part that is looked up for it, and lists with a part twice."""
    named = NamedParts(noted)
    if not named.known:
        return
    tops = [part for tree in noted.source.trees.values() for part in tree.body]
    for top in tops:
        if (
            isinstance(top, ast.ClassDef)
            and top.name not in noted.source.classes
            and not {*top.body} & {*noted.functions}
        ):
            continue
        for node in ast.walk(top):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value in named.known:
                for name in named.list_names(node):
                    if (what := named.find_contradiction(name, node.value, noted.source.parents[node])) is not None:
                        message = f"{name} is the part {node.value!r}, which is another one: {what}"
                        place = noted.source.find_place(node)
                        yield RuleFinding(rule, message, {"element": name, "value": node.value}, where=place)
            elif isinstance(node, ast.Assign) and (wrong := named.find_wrong_index(node)) is not None:
                message = f"{write_code(node)} is {wrong[1]!r}, which is another part: {wrong[2]}"
                place = noted.source.find_place(node)
                yield RuleFinding(rule, message, {"element": wrong[0], "value": wrong[1]}, where=place)
            elif isinstance(node, ast.List | ast.Tuple) and (found := named.find_missing(node)) is not None:
                message = f"{write_code(node)} names {found[0]!r} twice, and {found[1]!r} never"
                place = noted.source.find_place(node)
                yield RuleFinding(rule, message, {"element": found[0], "value": found[1]}, where=place)


class NamedParts:
    """The parts of a robot that the source names."""

    def __init__(self, noted: NotedEpisodes) -> None:
        self._source, self._instance = noted.source, noted.instance

    @functools.cached_property
    def _bodies(self) -> list[WorldBody]:
        return [body for client in self._instance.find_clients() for body in read_world(client).bodies]

    @functools.cached_property
    def _kinds(self) -> Mapping[str, set[str]]:
        """The names that the engine knows, by their kinds."""
        found: dict[str, set[str]] = {
            "link": {name for body in self._bodies for name in body.links},
            "joint": {joint.name for body in self._bodies for joint in body.joints},
        }
        if (simulation := find_mujoco(self._instance.env)) is not None:
            model = simulation[0]
            for kind, count in COUNTS.items():
                named = {getattr(model, kind)(number).name for number in range(getattr(model, count))}
                found[kind] = found.get(kind, set()) | named
        return {kind: names - {""} for kind, names in found.items()}

    @functools.cached_property
    def known(self) -> Collection[str]:
        """All of these."""
        return set[str]().union(*self._kinds.values())

    def _list_alike(self, part: str, lookup: ast.AST | None) -> set[str]:
        """Return the names of the kind that is looked up; where that is not known, of the kinds that have the part."""
        text = ast.unparse(lookup).lower() if isinstance(lookup, ast.Call) else ""
        kinds = [kind for kind in self._kinds if f".{kind}(" in text or f"mjobj_{kind}," in text]
        kinds = kinds or [kind for kind, names in self._kinds.items() if part in names]
        return set[str]().union(*(self._kinds[kind] for kind in kinds))

    def list_names(self, node: ast.expr) -> list[str]:
        """Return what a part is called that is looked up by its name: where it is kept, or the key of an entry."""
        below, above = node, self._source.parents[node]
        for _ in range(MOST_TRANSPARENT):
            match above:
                case ast.Call() if sum(isinstance(one, ast.Constant) for one in above.args) > 1:
                    return []
                case ast.Call() | ast.Attribute():
                    pass
                case ast.Subscript() if above.slice is below or above.value is below:
                    pass
                case ast.Tuple(elts=parts) if below in parts:
                    assign = self._source.parents[above]
                    targets = assign.targets if isinstance(assign, ast.Assign) else []
                    several = [one.elts for one in targets if isinstance(one, ast.Tuple | ast.List)]
                    place = parts.index(below)
                    return [read_name(one[place]) for one in several if len(one) == len(parts)]
                case ast.Assign(targets=targets):
                    return [name for target in targets if (name := read_name(target))]
                case ast.AnnAssign(target=target):
                    return [name for name in [read_name(target)] if name]
                case ast.Dict(keys=keys, values=values) if below in values:
                    key = keys[values.index(below)]
                    is_mirrored = below is node and isinstance(key, ast.Constant) and self._is_mirrored(key, node)
                    return [str(key.value)] if isinstance(key, ast.Constant) and not is_mirrored else []
                case ast.Return():
                    return [self._source.find_function(above).name]
                case _:
                    return []
            below, above = above, self._source.parents[above]
        return []

    def _is_mirrored(self, key: ast.Constant, part: ast.expr) -> bool:
        """Say whether an entry is a pair of a part and its counterpart."""
        name, other = str(key.value), str(part.value) if isinstance(part, ast.Constant) else ""
        return name in self.known or _is_like(name, other)

    def find_wrong_index(self, assign: ast.Assign) -> tuple[str, str, str] | None:
        """Return a name that is given the number of a link of PyBullet, that link, and what contradicts."""
        name, bodies = read_name(assign.targets[0]), [body for body in self._bodies if len(body.links) > 2]
        match assign.value:
            case ast.Constant(value=int(index)) if len(bodies) == 1 and {*split_name(name)} & NUMBER_WORDS:
                several = [*bodies[0].links[index + 1 : index + 2]]
                several += [joint.name for joint in bodies[0].joints if joint.index == index]
                found = [what for part in several if (what := self.find_contradiction(name, part, None)) is not None]
                return (name, several[0], found[0]) if found and len(found) == len(several) else None
        return None

    def find_contradiction(self, name: str, part: str, lookup: ast.AST | None) -> str | None:
        """Say what contradicts; None where nothing does. Another part has to bear the name."""
        words = [PLURALS.get(word, word) for word in split_name(name)]
        theirs = [PLURALS.get(word, word) for word in split_name(part)]
        if {*words} & RELATED or {*words} <= {*theirs}:
            return None
        sides, other_sides = _read_sides(words), _read_sides(theirs)
        for one, two in (pair for pair in itertools.chain(OPPOSITES, (pair[::-1] for pair in OPPOSITES))):
            if one in sides and two not in sides and two in other_sides and one not in other_sides:
                return f"one is {one}, the other {two}"
        parts, other_parts = PARTS & {*words}, PARTS & {*theirs}
        if len(parts) == 1 and other_parts and not parts & other_parts:
            wanted = min(parts)
            others = [known for known in sorted(self._list_alike(part, lookup)) if wanted in split_name(known)]
            if others:
                return f"there is {others[0]!r}"
        return None

    def find_missing(self, node: ast.List | ast.Tuple) -> tuple[str, str] | None:
        """Return the part that a list names twice, and the one like it that it leaves out."""
        names = [one.value for one in node.elts if isinstance(one, ast.Constant) and isinstance(one.value, str)]
        doubled = [name for name in dict.fromkeys(names) if names.count(name) > 1]
        if len(names) < 2 or len(names) < len(node.elts) or len(doubled) != 1 or not {*names} <= {*self.known}:
            return None
        missing = [one for one in sorted(self.known) if one not in names and _is_like(one, doubled[0])]
        others = [one for one in names if one != doubled[0]]
        fits = [one for one in missing if not others or any(_is_like(one, other) for other in others)]
        return (doubled[0], fits[0]) if len(names) - len({*names}) == 1 and fits else None


def _read_sides(words: Sequence[str]) -> set[str]:
    return set[str]().union(*(SIDES.get(word, set()) for word in words))


def _is_like(one: str, other: str) -> bool:
    """Say whether two names differ in one word that tells a side."""
    words, theirs = split_name(one), split_name(other)
    different = [pair for pair in zip(words, theirs, strict=False) if pair[0] != pair[1]]
    return len(words) == len(theirs) and len(different) == 1 and {*different[0]} <= SIDES.keys()
