"""Reading the run file."""

import pytest
import torch
from caraware.learn.config import BuiltInNetwork, ConfigError, MapBounds, PythonClass, TrainerConfig
from caraware.run.config import RunConfig
from synthetic import run_file


def test_the_values_of_a_run_file() -> None:
    config = TrainerConfig.from_run(run_file("x", learning_rate=1, hidden=[8, 4], checkpoint_interval=3))
    assert (config.learning_rate, config.hidden, config.checkpoint_interval_updates) == (1.0, (8, 4), 3)
    assert config.target_kl is None


def test_a_missing_key_is_named() -> None:
    run = run_file("x")
    del run["config"]["trainer"]["epochs"]
    with pytest.raises(ConfigError, match=r"lacks the key `trainer\.epochs`"):
        TrainerConfig.from_run(run)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("run.envs", "two", "`run.envs` is 'two'"),
        ("blackout.policy", "dark", "`blackout.policy` is 'dark'"),
        ("episode.training_episodes", 1.5, "`episode.training_episodes` is 1.5"),
    ],
)
def test_settings_of_the_run_are_never_guessed(key: str, value: object, message: str) -> None:
    table, _, name = key.partition(".")
    run = run_file("x")
    run["config"][table] |= {name: value}
    with pytest.raises(ConfigError, match=message):
        RunConfig.from_run(run)
    del run["config"][table][name]
    with pytest.raises(ConfigError, match=f"lacks the key `{key}`"):
        RunConfig.from_run(run)


def test_a_network_is_built_in_or_a_class() -> None:
    networks = [TrainerConfig.from_run(run_file("x", network=name)).network for name in ("gru", "my.nets:Wide")]
    assert networks == [BuiltInNetwork.GRU, PythonClass("my.nets", "Wide")]
    assert [str(network) for network in networks] == ["gru", "my.nets:Wide"]


def test_progress_counts_training_episodes_alone() -> None:
    run = run_file("x")
    run["run_dir"] = "x"
    run["config"]["episode"] |= {"training_episodes": 6, "evaluation_interval": 2}
    config = RunConfig.from_run(run)
    # Two of training, one of evaluation, and so on: t t e t t e t t e.
    trained = [0, 1, 2, 2, 3, 4, 4, 5, 6]
    assert [config.progress(episode) for episode in range(9)] == [count / 6 for count in trained]
    assert config.progress(20) == 1.0


def test_the_seed_of_the_run_is_the_trainer_s() -> None:
    run = run_file("x")
    run["config"]["run"]["seed"] = 7
    assert TrainerConfig.from_run(run).seed == 7


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("learning_speed", 1.0, "unknown key `trainer.learning_speed`"),
        ("learning_rate", "fast", "`trainer.learning_rate` is 'fast'"),
        ("horizon", True, "`trainer.horizon` is True"),
        ("hidden", 500, "`trainer.hidden` is 500"),
        ("hidden", [8, 4.5], "`trainer.hidden` is 4.5"),
        ("algorithm", "ppo", "unknown key `trainer.algorithm`"),
        ("network", "mlpp", "`trainer.network` is 'mlpp'"),
        ("activation", "gelu", "`trainer.activation` is 'gelu'"),
        ("reward", "best", "`trainer.reward` is 'best'"),
        ("device", "gpu", "`trainer.device` is 'gpu'"),
        ("matmul_precision", "float16", "`trainer.matmul_precision` is 'float16'"),
        ("estimates", "sometimes", "`trainer.estimates` is 'sometimes'"),
    ],
)
def test_a_wrong_value_names_the_key_and_the_cure(key: str, value: object, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        TrainerConfig.from_run(run_file("x", **{key: value}))
    assert message in str(caught.value)
    assert caught.value.help


def test_actions_span_the_map_and_may_leave_it() -> None:
    bounds = MapBounds(-10.0, 0.0, 30.0, 100.0)
    actions = torch.tensor([[-1.0, -1.0], [0.0, 0.0], [1.0, 1.0], [2.0, 0.0]])
    assert bounds.to_world_m(actions).tolist() == [[-10, 0], [10, 50], [30, 100], [50, 50]]


@pytest.mark.parametrize("bounds", [None, [1, 2, 3], [0, 0, 0, 10], ["a", 0, 1, 1]])
def test_bad_bounds_are_refused(bounds: object) -> None:
    run = run_file("x")
    run["map"]["bounds_m"] = bounds
    with pytest.raises(ConfigError, match=r"map\.bounds_m"):
        RunConfig.from_run(run)


def test_the_configuration_s_hash_does_not_depend_on_order() -> None:
    run = run_file("x")
    turned = {**run, "config": dict(reversed(run["config"].items()))}
    assert RunConfig.from_run(run).config_sha256 == RunConfig.from_run(turned).config_sha256
    assert RunConfig.from_run(run).config_sha256 != RunConfig.from_run(run_file("x", epochs=9)).config_sha256
