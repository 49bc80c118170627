"""RL013: misspelled."""

import difflib
import inspect
import re
from collections import Counter
from collections.abc import Iterator, Sequence

from rlctl.checking.experiments.build import judges_built
from rlctl.checking.instance import Instance
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.values import find_author, is_task

RULE = Rule(
    "RL013",
    "misspelled",
    Severity.WARNING,
    meaning="""
        A task defines an attribute or a method that nothing uses, and its name is nearly one that rlctl uses.
        It has no effect: for example, the time limit stays at its default, or success is never reported.
    """,
    fix="Correct the name; docs/task.md has all of them.",
    needs_instance=False,
)


@judges_built(RULE)
def _find_misspelled(instance: Instance) -> Iterator[RuleFinding]:
    if not is_task(instance.env):
        return
    from rlctl.task.batch import BatchTask
    from rlctl.task.task import Task, TaskDefinition

    author = type(find_author(instance.env))
    known = {*vars(TaskDefinition), *TaskDefinition.__annotations__, *vars(Task), *vars(BatchTask)}
    meant = {name for name in known if not name.startswith("_")}
    classes = author.__mro__[: author.__mro__.index(TaskDefinition)]
    words = _count_words(classes)
    for cls in classes:
        if not _read_module(cls):
            continue  # typed in somewhere: there is no file to look for uses in
        for name in vars(cls).keys() - meant:
            close = difflib.get_close_matches(name, meant - vars(cls).keys(), n=1, cutoff=0.7)
            if close and words[name] == 1:
                message = f"nothing uses {cls.__name__}.{name}. Did you mean {close[0]!r}?"
                yield RuleFinding(RULE, message, {"value": name, "expected": close[0]})


def _count_words(classes: Sequence[type]) -> Counter[str]:
    """Count the words of the modules of all classes: a base class may use what another module defines."""
    sources = {_read_module(cls) for cls in classes}
    return Counter(word for source in sources for word in re.findall(r"\w+", source))


def _read_module(cls: type) -> str:
    """Return the source of a class's module; empty if it has none."""
    try:
        return inspect.getsource(inspect.getmodule(cls) or cls)
    except (OSError, TypeError):
        return ""
