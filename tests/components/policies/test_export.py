"""Exported policies: the files of all kinds act as the originals, alone, and say what they are."""

import importlib.util
import json
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from components.core.normaliser import Normaliser
from components.data.recorded_states import plant_of, recorded_states
from components.policies import portable_check, portable_files
from components.policies.deployment import KINDS
from components.policies.export import check_target, export_policy
from components.policies.policy import Policy
from components.policies.portable import PortablePolicy, input_shapes
from components.policies.portable_check import TOLERANCE, States, compare, drawn_states
from components.policies.portable_files import FORMATS
from tests.components.policies.test_deployment import NOISE, Parts
from tests.components.synthetic import make_log
from tests.conftest import ROOT
from tests.walled import run_walled

LOG = make_log()
BOUNDS = ((0.0, 100.0), (-5.0, 5.0), (1013.0, 1030.0))
PLANT = replace(plant_of(LOG.card), bounds=BOUNDS, sampling=10.0)
STATES = recorded_states(LOG, 3)
RUNTIME = ("numpy", "onnxruntime", "flatbuffers", "google", "packaging")
"""ONNX Runtime and what pip installs with it."""


def policy_of(kind: str) -> Policy:
    """A policy of one lane that sees the log in a scale of its own; `steered` takes a proximity."""
    policy = Parts(kind if kind in KINDS else "tanh", ("a",)).policy()
    scaling = Normaliser.stack([Normaliser.fit(LOG.frames)])
    policy = replace(policy, frames=scaling)
    if kind != "steered":
        return policy
    (weight, bias), *others = policy.layers
    wider = torch.cat([weight, torch.ones(1, 1, weight.shape[-1])], dim=1)
    card = replace(policy.card, takes_proximity=True)
    return Policy.of_networks(card, {"actor": [(wider, bias), *others]}, scaling)


def inputs_of(policy: Policy, batch: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(3)
    found = {
        name: rng.standard_normal((batch, *shape), np.float32)
        for name, shape in input_shapes(policy.card).items()
    }
    found["history"] = STATES.histories[:batch]
    if "proximity" in found:
        found["proximity"] = rng.random(batch, np.float32)
    return found


def expected(policy: Policy, inputs: Mapping[str, np.ndarray]) -> np.ndarray:
    """The original's actions in the units of the plant."""
    given = {name: torch.from_numpy(value)[None] for name, value in inputs.items()}
    scaled = policy.act(given["history"], given.get("proximity"), given.get("noise"))[0].numpy()
    low, high = PLANT.limits.T
    return low + (scaled + 1) / 2 * (high - low)


def exported(policy: Policy, path: Path) -> Path:
    export_policy(policy, path, PLANT, STATES, {"run": "test/toy"})
    return path


CASES = [
    *((".pt2", kind) for kind in (*KINDS, "steered")),
    pytest.param(".onnx", "clipped_tanh_layers", marks=pytest.mark.slow(3)),
    pytest.param(".onnx", "gaussian_candidates", marks=pytest.mark.slow(4)),
    # the tests in clean environments below have the others
    *(pytest.param(".onnx", kind, marks=pytest.mark.exhaustive) for kind in ("tanh", "clipped")),
]


def assert_close(found: np.ndarray, wanted: np.ndarray) -> None:
    """Within the tolerance of an export: a share of each action's range, and float32's rounding."""
    rounding = np.spacing(np.abs(PLANT.limits).max(axis=1).astype(np.float32))
    reach = (PLANT.limits[:, 1] - PLANT.limits[:, 0]) / 2
    assert found.dtype == np.float32
    assert (np.abs(found - wanted) <= TOLERANCE * reach + rounding).all()


@pytest.mark.parametrize(("suffix", "kind"), CASES)
def test_a_file_acts_as_the_policy_for_one_machine_and_for_many(
    suffix: str, kind: str, tmp_path: Path
) -> None:
    policy = policy_of(kind)
    path = exported(policy, tmp_path / "new" / f"policy{suffix}")
    assert [file.name for file in path.parent.iterdir()] == [path.name], "one file alone"
    run = FORMATS[suffix].read(path)
    for batch in (1, 7):
        inputs = inputs_of(policy, batch)
        assert_close(run(inputs), expected(policy, inputs))
    content = path.read_bytes()
    assert not [word for word in (str(tmp_path), "site-packages") if word.encode() in content]


def test_without_bounds_actions_are_the_policy_s_own_numbers() -> None:
    policy = policy_of("clipped")
    history = torch.from_numpy(STATES.histories)
    module = PortablePolicy(policy, plant_of(LOG.card))
    assert torch.equal(module(history), policy.act(history[None])[0])


RUN_ONNX = """
import numpy as np, onnxruntime
session = onnxruntime.InferenceSession(sys.argv[1])
inputs = dict(np.load(sys.argv[2]))
np.save(sys.argv[3], session.run(None, inputs)[0])
print(session.get_modelmeta().custom_metadata_map["card.json"])
try:
    import torch
except ModuleNotFoundError:
    sys.exit(0)
sys.exit("there is a torch")
"""
RUN_RECIPE = """
import os
os.chdir(os.path.dirname(sys.argv[1]))
exec(open(sys.argv[2]).read())
np.save(sys.argv[3], [act(frame, 0.3) for frame in np.load("frames.npy")])
"""
RUN_PT2 = """
import numpy as np, torch
extra = {"card.json": ""}
policy = torch.export.load(sys.argv[1], extra_files=extra).module()
inputs = {name: torch.from_numpy(value) for name, value in np.load(sys.argv[2]).items()}
np.save(sys.argv[3], policy(**inputs).numpy())
print(extra["card.json"])
"""


@pytest.mark.slow(6)
@pytest.mark.parametrize("kind", ["steered", "perturbed_candidates"])
def test_onnx_needs_onnx_runtime_alone(kind: str, tmp_path: Path) -> None:
    policy = policy_of(kind)
    path, inputs = exported(policy, tmp_path / "policy.onnx"), inputs_of(policy, 5)
    np.savez(tmp_path / "inputs.npz", **inputs)
    out = tmp_path / "actions.npy"
    card = run_walled(RUN_ONNX, path, tmp_path / "inputs.npz", out, allowed=RUNTIME)
    assert_close(np.load(out), expected(policy, inputs))
    assert set(json.loads(card)["inputs"]) == set(inputs)


@pytest.mark.slow(3)
def test_the_recipe_of_the_page_runs_in_ten_lines(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "export.md").read_text(encoding="utf-8")
    [recipe] = re.findall(r"```python\n(import json.*?)```", page, re.DOTALL)
    assert len([line for line in recipe.splitlines() if line]) <= 10
    (tmp_path / "recipe.py").write_text(recipe, encoding="utf-8")
    policy = policy_of("steered")
    path, out = exported(policy, tmp_path / "policy.onnx"), tmp_path / "actions.npy"
    np.save(tmp_path / "frames.npy", LOG.frames[:5])
    run_walled(RUN_RECIPE, path, tmp_path / "recipe.py", out, allowed=RUNTIME)
    inputs = {"history": STATES.histories[:5], "proximity": np.full(5, 0.3, np.float32)}
    assert_close(np.load(out), expected(policy, inputs))  # an episode of the log from its start


@pytest.mark.slow(5)
def test_pt2_needs_pytorch_alone_and_both_formats_carry_the_card(tmp_path: Path) -> None:
    policy = policy_of("steered")
    path, inputs = exported(policy, tmp_path / "policy.pt2"), inputs_of(policy, 5)
    np.savez(tmp_path / "inputs.npz", **inputs)
    out = tmp_path / "actions.npy"
    project = ("components", "flows", "proximity_bench")
    text = run_walled(RUN_PT2, path, tmp_path / "inputs.npz", out, refused=project)
    assert_close(np.load(out), expected(policy, inputs))
    card = json.loads(text)
    assert card["inputs"]["history"]["shape"] == ["batch", 3, 6]
    assert card["inputs"]["history"]["features"] == list(policy.card.features)
    assert "newest first" in card["inputs"]["history"]["meaning"]
    assert card["inputs"]["proximity"]["range"] == [0.0, 1.0]
    assert card["output"]["actions"] == ["velocity", "gain", "shift"]
    assert card["output"]["bounds"] == [list(pair) for pair in BOUNDS]
    assert (card["algorithm"], card["dataset"], card["run"]) == ("test", "toy", "test/toy")
    assert (card["sampling"], card["log_digest"]) == (10.0, LOG.card.digest)
    check = {"states": 240, "source": "recorded, evenly over toy", "tolerance": TOLERANCE}
    assert check.items() <= card["check"].items()


def test_recorded_states_span_the_log_and_repeat_first_frames() -> None:
    assert len(STATES.histories) == LOG.transitions == 240
    np.testing.assert_array_equal(STATES.histories[0], LOG.frames[[0, 0, 0]])
    np.testing.assert_array_equal(STATES.histories[-1], LOG.frames[[-2, -3, -4]])
    few = LOG.spread_histories(3, 2)
    np.testing.assert_array_equal(few[:, 0], LOG.frames[LOG.frame_rows()[[0, 119, 239]]])


def test_drawn_states_have_the_moments_of_the_scaling() -> None:
    policy = policy_of("tanh")
    drawn = drawn_states(policy).histories
    assert drawn.shape == (1000, 3, 6)
    # 3,000 draws a feature: deviations from mean and scale of more than 5 of their own never happen
    mean, scale = policy.frames.mean[0].numpy(), policy.frames.scale[0].numpy()
    assert (np.abs(drawn.mean(axis=(0, 1)) - mean) < 5 * scale / np.sqrt(3000)).all()
    assert (np.abs(drawn.std(axis=(0, 1)) / scale - 1) < 5 / np.sqrt(6000)).all()


@pytest.mark.parametrize("error", [1e-3, np.nan])
def test_a_file_that_differs_is_not_kept(
    error: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = FORMATS[".pt2"].read
    wrong = replace(
        FORMATS[".pt2"], read=lambda path: lambda inputs: read(path)(inputs) + np.float32(error)
    )
    monkeypatch.setattr(portable_files, "FORMATS", {".pt2": wrong})
    path = tmp_path / "policy.pt2"
    path.write_text("the one before")
    with pytest.raises(ValueError, match=r"policy\.pt2 is not written: it differs from the policy"):
        export_policy(policy_of("tanh"), path, PLANT, STATES, overwrite=True)
    assert path.read_text() == "the one before"
    assert list(tmp_path.iterdir()) == [path]


def test_the_tolerance_is_a_share_of_each_action_s_range() -> None:
    policy = policy_of("tanh")
    reach = np.diff(PLANT.limits).T / 2

    def off(share: float) -> Any:
        return lambda inputs: (expected(policy, inputs) + share * reach).astype(np.float32)

    assert compare(policy, PLANT, off(0.5 * TOLERANCE), STATES).difference < TOLERANCE
    with pytest.raises(ValueError, match=r"by 3.*e-05 of half an action's range, and 1.0e-05 is"):
        compare(policy, PLANT, off(3.5 * TOLERANCE), STATES)


def test_a_sharp_policy_may_differ_by_its_own_rounding_but_not_without_limit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    like, reach = policy_of("tanh"), np.diff(PLANT.limits).T / 2
    *inner, (weight, bias) = like.layers
    last = 1000 * weight, 1000 * bias
    sharp = Policy.of_networks(like.card, {"actor": [*inner, last]}, like.frames)

    def allowed(policy: Policy, share: float) -> float:
        return compare(policy, PLANT, lambda i: expected(policy, i) + share * reach, STATES).allowed

    assert allowed(like, 0.0) == TOLERANCE
    assert 2 * TOLERANCE < allowed(sharp, 2 * TOLERANCE) < portable_check.LIMIT
    with pytest.raises(ValueError, match=r"by 2\.0e-02 of half an action's range, and .*e-04 is"):
        allowed(sharp, 2 * portable_check.LIMIT)
    monkeypatch.setattr(portable_check, "LIMIT", 1e-4)
    assert allowed(sharp, 0.0) == 1e-4


def test_proximities_are_checked_over_their_range() -> None:
    policy, asked = policy_of("steered"), []

    def run(inputs: Mapping[str, np.ndarray]) -> np.ndarray:
        asked.append(inputs["proximity"])
        return expected(policy, inputs)

    checked = compare(policy, PLANT, run, STATES)
    assert set(np.concatenate(asked)) == set(np.float32(portable_check.PROXIMITIES))
    assert (checked.states, checked.actions) == (240, 1200)
    assert len(asked[0]) == 1, "one machine alone, as on a plant"
    assert str(checked).startswith("1200 actions in 240 states differ by at most ")


@pytest.mark.parametrize("kind", NOISE)
def test_another_candidate_must_be_as_good_to_the_critic(kind: str) -> None:
    policy = policy_of(kind)
    states = States(STATES.histories[:20], "recorded")

    def first_candidate(inputs: Mapping[str, np.ndarray]) -> np.ndarray:
        noise = np.repeat(inputs["noise"][:, :1], inputs["noise"].shape[1], axis=1)
        return expected(policy, {**inputs, "noise": noise})

    with pytest.raises(ValueError, match="differs from the policy"):
        compare(policy, PLANT, first_candidate, states)
    weight, bias = policy.networks["critic"][-1]
    weight.zero_()
    bias.zero_()  # now all candidates are equally good
    assert compare(policy, PLANT, lambda i: expected(policy, i), states).ties == 0

    def last_candidate(inputs: Mapping[str, np.ndarray]) -> np.ndarray:
        return expected(policy, {**inputs, "noise": inputs["noise"][:, ::-1].copy()})

    assert compare(policy, PLANT, last_candidate, states).ties == 20


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("policy.pkl", r"policy\.pkl must end in \.onnx or \.pt2\.$"),
        ("policy", r"policy must end in"),
        ("there.onnx", r"there\.onnx exists; name another file, or overwrite it"),
        ("folder.pt2", r"folder\.pt2 is a folder; name a file"),
        ("there.onnx/new/a.pt2", r"there\.onnx is a file; name a file in a folder"),
    ],
)
def test_targets_that_cannot_be_are_refused(name: str, reason: str, tmp_path: Path) -> None:
    (tmp_path / "there.onnx").touch()
    (tmp_path / "folder.pt2").mkdir()
    with pytest.raises(ValueError, match=reason):
        check_target(tmp_path / name)
    check_target(tmp_path / "there.onnx", overwrite=True)


def test_missing_packages_are_named_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    there = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if "onnx" in name else there(name)
    )
    with pytest.raises(ValueError, match=r"without onnx and onnxscript and onnxruntime; install"):
        check_target(Path("policy.onnx"))
    check_target(Path("policy.pt2"))
