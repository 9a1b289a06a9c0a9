"""Layers of settings: which wins, and what a domain or a dataset may change."""

import dataclasses
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from omegaconf import DictConfig, OmegaConf

from flows.configuration import composition
from flows.configuration.checking import SettingsError
from flows.configuration.composition import special_settings, with_limits
from flows.configuration.files import CONF
from flows.configuration.settings import load_settings

GROUPS = {
    "algorithm": {"moose": {"updates": 1000, "optimizer": "sgd"}, "bc": {"updates": 500}},
    "model": {"clone": {"hidden": [20], "epochs": 50}, "net": {"hidden": 30}},
    "domain": {
        "robots": {
            "algorithm": {"moose": {"updates": 5000, "optimizer": "adam"}},
            "model": {"clone": {"hidden": [128]}},
            "model_for": {"wsbc": {"clone": {"hidden": [40]}, "net": {"hidden": 7}}},
        }
    },
    "dataset": {
        "hopper-1.0": {"domain": "robots", "algorithm": {"moose": {"updates": 900}}},
        "walker": {"domain": "robots"},
        "mediocre-0.2": {"controller": "mediocre"},
    },
}


def special(*later: dict) -> dict:
    return by_dataset([OmegaConf.create(layer) for layer in (GROUPS, *later)])


def by_dataset(layers: list[DictConfig]) -> dict:
    found = special_settings(layers, GROUPS["dataset"])
    return {p.removeprefix("dataset."): own for p, own in found.items() if p[:6] != "domain"}


def test_settings_of_a_dataset_win_over_its_domain_s_and_these_over_general_ones() -> None:
    found = special()
    assert set(found) == {"hopper-1.0", "walker"}, "the others have the settings of everybody"
    assert found["walker"]["algorithm"]["moose"] == {"updates": 5000, "optimizer": "adam"}
    assert found["hopper-1.0"]["algorithm"]["moose"] == {"updates": 900, "optimizer": "adam"}
    assert found["walker"]["algorithm"]["bc"] == {"updates": 500}
    assert found["walker"]["model"]["clone"] == {"hidden": [128], "epochs": 50}


def test_a_dataset_without_a_domain_may_change_settings() -> None:
    own = {"dataset": {"mediocre-0.2": {"algorithm": {"bc": {"updates": 7}}}}}
    for found in (special(own), by_dataset([OmegaConf.merge(GROUPS, own)])):
        assert found["mediocre-0.2"]["algorithm"]["bc"] == {"updates": 7}
        assert found["mediocre-0.2"]["algorithm"]["moose"] == GROUPS["algorithm"]["moose"]
        assert found["mediocre-0.2"]["model"] == GROUPS["model"]


def test_an_algorithm_may_have_its_own_model_settings() -> None:
    wanted = special()["walker"]["model_for"]
    assert wanted == {
        "wsbc": {"clone": {"hidden": [40], "epochs": 50}, "net": {"hidden": 7}},
    }


def test_a_later_layer_wins_over_all_of_an_earlier_one() -> None:
    profile = {"algorithm": {"moose": {"updates": 100}}, "model": {"clone": {"epochs": 2}}}
    words = {"domain": {"robots": {"algorithm": {"moose": {"updates": 50}}}}}
    found = special(profile)
    assert found["hopper-1.0"]["algorithm"]["moose"] == {"updates": 100, "optimizer": "adam"}
    assert found["walker"]["model_for"]["wsbc"]["clone"] == {"hidden": [40], "epochs": 2}
    assert special(profile, words)["walker"]["algorithm"]["moose"]["updates"] == 50


def test_a_domain_without_a_file_is_named() -> None:
    with pytest.raises(SettingsError, match=r"dataset\.robo\.domain='mars' .* valid ones are rob"):
        special_settings(
            [OmegaConf.create(GROUPS | {"dataset": {"robo": {"domain": "mars"}}})], ["robo"]
        )


def test_domains_of_the_chosen_datasets_come_before_these() -> None:
    layers = [OmegaConf.create(GROUPS), OmegaConf.create({})]
    assert list(special_settings(layers, ["walker"])) == ["domain.robots", "dataset.walker"]
    assert special_settings(layers, ["mediocre-0.2"]) == {}
    found = special_settings(layers, ["walker"])
    assert found["domain.robots"] == found["dataset.walker"]


@pytest.mark.parametrize("place", ["domain", "dataset"])
def test_settings_of_algorithms_and_models_must_be_groups(place: str) -> None:
    name = {"domain": "robots", "dataset": "walker"}[place]
    for fields, says in (
        ({"model_for": 3}, rf"{place}\.{name}\.model_for=3 must be a group of keys"),
        ({"model_for": {"wsbc": {"net": 3}}}, rf"{place}\.{name}\.model_for\.wsbc\.net=3 must be"),
        ({"algorithm": {"moose": None}}, rf"{place}\.{name}\.algorithm\.moose=None must be"),
    ):
        with pytest.raises(SettingsError, match=says):
            special({place: {name: fields}})


@pytest.fixture
def conf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A copy of conf/ that may be changed."""
    monkeypatch.setattr(composition, "CONF", tmp_path / "conf")
    composition.base_layers.cache_clear()
    yield shutil.copytree(CONF, tmp_path / "conf")
    composition.base_layers.cache_clear()


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("algorithm:\n  lyon:\n    updates: 3\n", "Unknown key 'algorithm.lyon'; .*mean 'lion'"),
        ("model:\n  action_vae:\n    epoch: 3\n", "Unknown key 'model.action_vae.epoch'; valid"),
        ("experts:\n  training:\n    depth: 3\n", "Unknown key 'experts.training.depth'; valid"),
        ("tunning:\n  trials: 3\n", "Unknown key 'tunning'; valid keys .* Did you mean 'tuning'"),
        ("training: 3\n", "training=3 must be a group of keys"),
        ("seeds: [0, 0]\n", "must be a list of different whole numbers"),
        ("seeds: [0,\n", "mine.yaml is no valid YAML"),
    ],
)
def test_a_wrong_profile_ends_in_one_sentence(conf: Path, content: str, says: str) -> None:
    (conf / "profile" / "mine.yaml").write_text(content, encoding="utf-8")
    with pytest.raises(SettingsError, match=says) as caught:
        load_settings(["profile=mine"])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("kept", "lacking"),
    [("", "data, datasets, "), ("seeds: [0]\n", "data, datasets, algorithms, ")],
)
def test_a_config_file_that_lost_settings_is_named(conf: Path, kept: str, lacking: str) -> None:
    (conf / "config.yaml").write_text(kept, encoding="utf-8")
    with pytest.raises(SettingsError, match=f"^conf/config.yaml lacks {lacking}.*; take it from"):
        load_settings(["dry_run=true"])


def test_profiles_may_have_the_old_name_of_the_proximity_step(conf: Path) -> None:
    written = "evaluation:\n  lambda_step: 0.2\n"
    (conf / "profile" / "mine.yaml").write_text(written, encoding="utf-8")
    assert load_settings(["profile=mine"]).evaluation.proximity_step == 0.2
    words = ["profile=mine", "evaluation.proximity_step=0.5"]
    assert load_settings(words).evaluation.proximity_step == 0.5


def test_a_dataset_s_file_may_say_what_it_wants_otherwise(conf: Path) -> None:
    file = conf / "dataset" / "bad-0.4.yaml"
    told = file.read_text(encoding="utf-8") + "  algorithm:\n    lion:\n      beta: 0.5\n"
    file.write_text(told, encoding="utf-8")
    settings = load_settings([])
    usual = settings.algorithm["lion"]
    assert settings.algorithm_on("bad-0.4", "lion") == dataclasses.replace(usual, beta=0.5)
    assert settings.algorithm_on("bad-0.6", "lion") == usual
    assert load_settings(["algorithm.lion.beta=0.2"]).algorithm_on("bad-0.4", "lion").beta == 0.2


@pytest.mark.parametrize("file", ["dataset/bad-0.4", "domain/mujoco"])
def test_a_copied_file_is_named_and_does_not_win_over_the_original(conf: Path, file: str) -> None:
    plain = load_settings(["datasets=[bad-0.4,hopper]"])
    copied = (conf / f"{file}.yaml").read_text(encoding="utf-8").replace("0", "1")
    (conf / f"{file} copy.yaml").write_text(copied, encoding="utf-8")
    composition.base_layers.cache_clear()
    found = load_settings(["datasets=[bad-0.4,hopper]"])
    [note] = found.notes
    assert f"{file} copy.yaml must hold one key, its own name" in note
    assert found == plain.model_copy(update={"notes": found.notes})


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("mine:\n\tcontroller: bad\n", r"mine\.yaml is no valid YAML in line 2"),
        ("", r"dataset/mine\.yaml must hold one key, its own name 'mine', but holds nothing"),
        ("mine:\n  controller: bda\n  epsilon: 0\n", "dataset.mine: unknown controller 'bda'"),
        ("mine:\n  domain: mars\n", r"dataset\.mine\.domain='mars' has no file"),
        ("mine:\n  domain: {}\n", r"dataset\.mine\.domain=\{\} has no file"),
        ("mine:\n  domain: new\n", r"domain/new\.yaml must hold one key"),
        (
            "mine:\n  controller: bad\n  epsilon: 0\n  algorithm: {bc: {updates: 0}}\n",
            r"dataset\.mine\.algorithm\.bc: updates",
        ),
        ("mine: 3\n", "dataset.mine=3 must be a group of keys"),
    ],
)
def test_a_broken_dataset_matters_only_to_those_who_select_it(
    conf: Path, content: str, says: str
) -> None:
    (conf / "dataset" / "mine.yaml").write_text(content, encoding="utf-8")
    (conf / "domain" / "new.yaml").write_text("old: {}\n", encoding="utf-8")
    assert load_settings(["datasets=[bad-0.4]"]).datasets == ("bad-0.4",)
    for word in ("datasets=[mine]", "datasets=all"):
        with pytest.raises(SettingsError, match=says) as caught:
            load_settings([word])
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("of_domain", "of_dataset", "chosen"),
    [
        ("{}", "", True),
        ("{by_name_only: true}", "", False),
        ("{}", "  by_name_only: true\n", False),
        ("{by_name_only: true}", "  by_name_only: false\n", True),
    ],
)
def test_all_leaves_out_what_is_chosen_by_name_only(
    conf: Path, of_domain: str, of_dataset: str, chosen: bool
) -> None:
    written = f"mine:\n  domain: new\n  controller: bad\n  epsilon: 0.1\n{of_dataset}"
    (conf / "dataset" / "mine.yaml").write_text(written, encoding="utf-8")
    (conf / "domain" / "new.yaml").write_text(f"new: {of_domain}\n", encoding="utf-8")
    assert ("mine" in load_settings(["datasets=all"]).datasets) == chosen
    assert load_settings(["datasets=[mine]"]).datasets == ("mine",)


def test_by_name_only_is_true_or_false(conf: Path) -> None:
    written = "mine:\n  controller: bad\n  epsilon: 0.1\n  by_name_only: perhaps\n"
    (conf / "dataset" / "mine.yaml").write_text(written, encoding="utf-8")
    with pytest.raises(SettingsError, match=r"dataset\.mine\.by_name_only='perhaps'"):
        load_settings(["datasets=[mine]"])


@pytest.mark.parametrize("name", ["größe", "1.0", "a b", "bad-0.4 (copy)"])
def test_a_dataset_may_have_any_name_that_is_its_file_s(conf: Path, name: str) -> None:
    written = f'"{name}":\n  controller: bad\n  epsilon: 0.1\n'
    (conf / "dataset" / f"{name}.yaml").write_text(written, encoding="utf-8")
    assert load_settings([f"datasets=[{name}]"]).dataset[name].epsilon == 0.1


def test_a_profile_is_called_as_its_file_and_others_do_not_matter(conf: Path) -> None:
    shutil.copy(conf / "profile" / "quick.yaml", conf / "profile" / "mine.yaml")
    (conf / "profile" / "broken.yaml").write_text("a: [\n", encoding="utf-8")
    with (conf / "profile" / "mine.yaml").open("a", encoding="utf-8") as file:
        file.write("profile_name: quick\n")
    assert load_settings(["profile=mine"]).profile_name == "mine"
    assert load_settings(["profile=mine"]).datasets == load_settings(["profile=quick"]).datasets


DEFAULTS = {
    "algorithm": {
        "bc": {"updates": 500, "batch": 9},
        "moose": {"updates": 30, "penalty": 0.5},
        "new": {"updates": 500, "batch": 9},
    },
    "model": {"net": {"epochs": 50}},
}


def limited(profile: dict) -> dict:
    found = with_limits(OmegaConf.create(profile), DEFAULTS)
    return OmegaConf.to_container(found)  # type: ignore[return-value]


def test_algorithms_that_a_profile_does_not_name_have_its_limits_or_less() -> None:
    others = {"algorithm": {"updates": 40, "batch": 4}, "model": {"epochs": 2}}
    found = limited({"seeds": [0], "algorithm": {"bc": {"updates": 70}}, "others": others})
    assert found == {
        "seeds": [0],
        "algorithm": {
            "bc": {"updates": 70},
            "moose": {"updates": 30},
            "new": {"updates": 40, "batch": 4},
        },
        "model": {"net": {"epochs": 2}},
    }


def test_a_profile_without_limits_leaves_the_defaults_alone() -> None:
    found = limited({"seeds": [0]})
    assert found.pop("seeds") == [0]
    assert not any(fields for group in found.values() for fields in group.values())


@pytest.mark.parametrize(
    ("others", "says"),
    [
        ({"modle": {"epochs": 2}}, "others.*modle"),
        ({"model": {"epochs": "few"}}, "others.model.epochs='few'"),
    ],
)
def test_limits_are_numbers_of_algorithms_and_models(others: dict, says: str) -> None:
    with pytest.raises(SettingsError, match=says):
        limited({"others": others})
