"""The models of the algorithms' parameters are SB3's signatures, and `docs/recipe.md` is made from them."""

import importlib.util
import inspect
from pathlib import Path

import pytest

from rlctl.policy.file import ACTOR_CRITIC
from rlctl.policy.torch_policy import ACTIVATIONS
from rlctl.policy.torch_policy import ALGORITHMS as CLASSES
from rlctl.recipe.hyperparameters import ALGORITHM_PARAMETERS
from rlctl.recipe.network_parameters import NETWORK_PARAMETERS
from rlctl.recipe.recipe import ALGORITHMS

_spec = importlib.util.spec_from_file_location("generate", Path(__file__).parents[2] / "docs" / "generate.py")
generate = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(generate)
PAGES = generate.render_pages()

# Set by rlctl itself, or not plain data.
NOT_FOR_RECIPES = {
    *("self", "policy", "env", "seed", "device", "verbose", "tensorboard_log", "policy_kwargs", "_init_setup_model"),
    "optimize_memory_usage",  # a checkpoint needs the whole buffer
    "stats_window_size",  # of means that nothing shows: metrics have those since the row before
    *("rollout_buffer_class", "rollout_buffer_kwargs", "replay_buffer_class", "replay_buffer_kwargs"),
}
NOT_FOR_POLICIES = {
    *("self", "observation_space", "action_space", "lr_schedule", "optimizer_class", "optimizer_kwargs"),
    *("features_extractor_class", "use_sde", "normalize_images"),
}


def defaults(cls, without):
    """Return the arguments of a constructor, with those that it passes on to the class above."""
    parameters = inspect.signature(cls.__init__).parameters
    passes_on = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values())
    inherited = defaults(cls.__mro__[1], without) if passes_on else {}
    return inherited | {
        name: parameter.default
        for name, parameter in parameters.items()
        if name not in without and parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY)
    }


def of_model(model):
    found = {name: field.default for name, field in model.model_fields.items()}
    if "activation_fn" in found:
        found["activation_fn"] = ACTIVATIONS[found["activation_fn"]]
        assert found.pop("features_extractor_class") is None  # SB3's default, which follows from the observation
        assert found.pop("policy_class") is None  # SB3's argument of the algorithm
    return found


def test_every_algorithm_has_its_models():
    assert tuple(ALGORITHM_PARAMETERS) == tuple(NETWORK_PARAMETERS) == ALGORITHMS == tuple(CLASSES)


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_names_and_defaults_are_those_of_the_classes(algo):
    cls = CLASSES[algo]
    ours = {"actor_average": 0.9997 if algo == "xqc" else 0.0} if algo in ACTOR_CRITIC else {}
    ours |= {"policy_delay": 1} if algo in ("sac", "tqc") else {}
    assert of_model(ALGORITHM_PARAMETERS[algo]) == defaults(cls, NOT_FOR_RECIPES) | ours
    for policy in cls.policy_aliases.values():
        assert of_model(NETWORK_PARAMETERS[algo]) == defaults(policy, NOT_FOR_POLICIES)


@pytest.mark.parametrize("name", PAGES)
def test_the_generated_files_are_current(name):
    file = Path(generate.__file__).parent / name
    assert file.read_text(encoding="utf-8") == PAGES[name], "write it again: python docs/generate.py"


def test_every_key_has_a_meaning_and_what_it_may_be():
    rows = [line.split("|")[1:-1] for line in generate.render_recipe_page().splitlines() if line.startswith("| `")]
    assert len(rows) > 200
    assert all(value.strip() not in ("", "any value") and meaning.strip() for _, value, _, meaning in rows)
