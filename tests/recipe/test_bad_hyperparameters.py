"""Hyperparameters that cannot be, of an algorithm and of its networks."""

import pytest

from tests.recipe.test_bad_recipes import refused


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("learning_rate", value) for value in (".nan", ".inf", "-.inf", "'0.1'", "true", "null", "[0.1]", "{a: 1}")),
        *((name, ".nan") for name in ("gamma", "ent_coef", "max_grad_norm", "clip_range", "log_std_init")),
    ],
)
def test_every_number_is_a_finite_one(name, value):
    section = "policy_kwargs" if name == "log_std_init" else "algo_kwargs"
    message = refused(None, [f"{section}.{name}={value}"])
    assert message.startswith(f"{section}.{name}: ")
    assert ": expected a number" in message


NETWORK = "expected [64, 64] or {pi: [64, 64], vf: [64, 64]}, got "


@pytest.mark.parametrize(
    ("algo", "setting", "expected"),
    [
        ("ppo", "learning_rate=3", "expected a number in (0, 1] or lin_NUMBER, got 3"),
        ("ppo", "learning_rate=0", "expected a number in (0, 1] or lin_NUMBER, got 0"),
        ("ppo", "learning_rate=lin_-3e-4", "expected a number in (0, 1] or lin_NUMBER, got 'lin_-3e-4'"),
        ("ppo", "learning_rate=lin_inf", "expected a number in (0, 1] or lin_NUMBER, got 'lin_inf'"),
        ("ppo", "learning_rate=lin_", "expected a number in (0, 1] or lin_NUMBER, got 'lin_'"),
        ("ppo", "learning_rate=linear", "expected a number in (0, 1] or lin_NUMBER, got 'linear'"),
        ("ppo", "gamma=99", "expected a number in (0, 1], got 99"),
        ("ppo", "gae_lambda=1.5", "expected a number in [0, 1], got 1.5"),
        ("ppo", "n_epochs=0", "expected a whole number in [1, 1e9], got 0"),
        ("ppo", "batch_size=0", "expected a whole number in [2, 1e9], got 0"),
        ("ppo", "n_steps=1.5", "expected a whole number in [1, 1e9], got 1.5"),
        ("ppo", "ent_coef=auto", "expected a number >= 0, got 'auto'"),
        ("ppo", "vf_coef=-1", "expected a number >= 0, got -1"),
        ("ppo", "clip_range=-1", "expected a number in (0, 10] or lin_NUMBER, got -1"),
        ("ppo", "clip_range_vf=0", "expected a number > 0 or lin_NUMBER or null, got 0"),
        ("ppo", "target_kl=0", "expected a number > 0 or null, got 0"),
        ("ppo", "normalize_advantage=1", "expected true or false, got 1"),
        ("ppo", "use_sde=on", "expected true or false, got 'on'"),
        ("ppo", "sde_sample_freq=-2", "expected a whole number in [1, 1e9] or -1, got -2"),
        ("a2c", "rms_prop_eps=0", "expected a number in (0, 1], got 0"),
        ("a2c", "use_rms_prop=null", "expected true or false, got None"),
        ("sac", "ent_coef=autoo", "expected a number >= 0 or auto or auto_NUMBER, got 'autoo'"),
        ("sac", "ent_coef=auto_-1", "expected a number >= 0 or auto or auto_NUMBER, got 'auto_-1'"),
        ("sac", "ent_coef=-1", "expected a number >= 0 or auto or auto_NUMBER, got -1"),
        ("sac", "tau=0", "expected a number in (0, 1], got 0"),
        ("sac", "buffer_size=0", "expected a whole number in [1, 1e15], got 0"),
        ("sac", "train_freq=0", "expected a whole number in [1, 1e9], got 0"),
        ("sac", "train_freq=[1, episode]", "expected a whole number in [1, 1e9], got [1, 'episode']"),
        ("sac", "gradient_steps=-2", "expected a whole number in [1, 1e9] or -1, got -2"),
        ("sac", "gradient_steps=0", "expected a whole number in [1, 1e9] or -1, got 0"),
        ("sac", "learning_starts=-1", "expected a whole number in [0, 1e9], got -1"),
        ("sac", "target_entropy=low", "expected a number or auto, got 'low'"),
        ("sac", "target_entropy=.nan", "expected a number or auto, got nan"),
        ("td3", "action_noise=-1", "expected a number >= 0 or null, got -1"),
        ("td3", "action_noise=.nan", "expected a number >= 0 or null, got nan"),
        ("td3", "policy_delay=0", "expected a whole number in [1, 1e9], got 0"),
        ("td3", "target_noise_clip=-0.5", "expected a number >= 0, got -0.5"),
        ("dqn", "exploration_final_eps=2", "expected a number in [0, 1], got 2"),
        ("dqn", "target_update_interval=0", "expected a whole number in [1, 1e9], got 0"),
        ("tqc", "top_quantiles_to_drop_per_net=25", "25 of 25 quantiles are dropped, so none remains; it "),
        (
            "ppo",
            "net_arch=[-1]",
            "expected a list, each element a whole number in [1, 65536] or a mapping of pi, vf or null,",
        ),
        (
            "ppo",
            "net_arch=[0]",
            "expected a list, each element a whole number in [1, 65536] or a mapping of pi, vf or null,",
        ),
        (
            "ppo",
            "net_arch=[a]",
            "expected a list, each element a whole number in [1, 65536] or a mapping of pi, vf or null,",
        ),
        (
            "ppo",
            "net_arch=64",
            "expected a list, each element a whole number in [1, 65536] or a mapping of pi, vf or null,",
        ),
        (
            "ppo",
            "net_arch={pi: [64]}",
            "expected a list, each element a whole number in [1, 65536] or a mapping of pi, vf or null,",
        ),
        (
            "ppo",
            "net_arch={pi: [64], qf: [64]}",
            "expected a list, each element a whole number in [1, 65536] or a mapping of pi, vf or null,",
        ),
        (
            "ppo",
            "net_arch={pi: [64], vf: [0]}",
            "expected a list, each element a whole number in [1, 65536] or a mapping of pi, vf or null,",
        ),
        (
            "dqn",
            "net_arch={pi: [64], qf: [64]}",
            "expected a list, each element a whole number in [1, 65536] or null, got {'pi': [64], 'qf':",
        ),
        ("ppo", "log_std_init=100", "expected a number in [-20, 10], got 100"),
        (
            "ppo",
            "activation_fn=[tanh]",
            "expected tanh or relu or elu or silu or FILE.py:CLASS or MODULE:CLASS, got ['tanh']",
        ),
        ("ppo", "features_extractor_kwargs={features_dim: 0}", "expected a whole number in [1, 65536], got 0"),
        (
            "ppo",
            "features_extractor_kwargs={feature_dim: 9}",
            "feature_dim' for ppo. Did you mean 'features_dim'? Keys here: features_dim, ",
        ),
        ("sac", "n_critics=1e6", "expected a whole number in [1, 100], got 1000000.0"),
        ("recurrent_ppo", "lstm_hidden_size=0", "expected a whole number in [1, 65536], got 0"),
        (
            "recurrent_ppo",
            "lstm_kwargs={device: meta}",
            "no key 'policy_kwargs.lstm_kwargs.device' for recurrent_ppo. Keys here: dropout, bias.",
        ),
        ("ppo", "activation_fn=tahn", "silu or FILE.py:CLASS or MODULE:CLASS, got 'tahn'. Did you mean 'tanh'?"),
        ("ppo", "gama=0.9", "no key 'algo_kwargs.gama' for ppo. Did you mean 'gamma'? Keys here: learning_rate, "),
        ("dqn", "use_sde=true", "no key 'algo_kwargs.use_sde' for dqn."),
        ("xqc", "v_max=-5", "-5 is not above v_min, -5"),
        ("tqc", "n_quantiles=0", "expected a whole number in [1, 10000], got 0"),
    ],
)
def test_hyperparameters_that_make_no_sense(algo, setting, expected):
    name = setting.partition("=")[0]
    of_the_network = name.startswith(
        ("net_", "log_std", "activation", "features", "n_crit", "lstm", "n_quant", "v_max")
    )
    section = "policy_kwargs" if of_the_network else "algo_kwargs"
    message = refused(None, [f"algo={algo}", f"{section}.{setting}"])
    assert message.startswith((f"{section}.{name}", f"no key '{section}.{name}"))
    assert expected in message
