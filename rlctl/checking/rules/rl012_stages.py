"""RL012: stages."""

from collections.abc import Iterator, Sequence
from typing import Any

from rlctl.checking.experiments.variants import TaskVariants, describe_cause, judges_variants, play_variant
from rlctl.checking.instance import Context, EnvironmentRaised
from rlctl.checking.records import ChildMessage, Skipped
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.environments import registry
from rlctl.errors import RecipeError
from rlctl.recipe.recipe_files import read

RULE = Rule(
    "RL012",
    "stages",
    Severity.ERROR,
    meaning="""
        A stage of the task's curriculum has an unknown key, cannot be built, or has other spaces than the first
        stage.
    """,
    fix="""
        Correct the stage that the message names; docs/recipe.md has the keys of a stage. One policy learns in
        all stages, so no task parameter of a stage may change the spaces.
    """,
    needs_instance=False,
)


@judges_variants(RULE)
def _judge_stages(variants: TaskVariants) -> Iterator[ChildMessage]:
    stages = _find_stages(variants.context.spec.task, variants.task)
    if stages:
        yield from _play_stages(variants.context, stages)
    else:
        yield Skipped(RULE.id, "the task has no stages", applies=False)


def _find_stages(name: str, task: Any) -> Sequence[Any]:
    file = registry.find_recipe_file(name)
    stages = task.stages
    if file is not None and "stages" in file.read_text(encoding="utf-8", errors="replace"):
        stages = read(file).get("stages", stages)
    return stages if isinstance(stages, list | tuple) else ()  # another type is refused with the recipe


def _play_stages(context: Context, stages: Sequence[Any]) -> Iterator[RuleFinding]:
    from rlctl.environments.info import describe as describe_env  # both with pydantic's models, which load slowly
    from rlctl.recipe.recipe import validate

    spec, first = context.spec, None
    settings = {"task": spec.parameters, "events": spec.events, "randomize": spec.randomize, "stages": list(stages)}
    try:
        specs = validate(settings, "stages").env_specs(spec.task)
    except RecipeError as error:
        yield RuleFinding(RULE, str(error))
        return
    for number, stage in enumerate(specs, start=1):
        try:
            with context.fresh(spec=stage) as instance:
                play_variant(instance)
                description = describe_env(instance.env)
        except EnvironmentRaised as error:
            yield RuleFinding(RULE, f"stage {number} of {len(specs)}: {describe_cause(error)}")
            continue
        first = first or description
        if difference := description.find_difference(first, "stage 1's"):
            yield RuleFinding(RULE, f"stage {number} of {len(specs)}: {difference}")
