"""TD3+BC and CQL in plain JAX, run by an interpreter that has JAX: `make peers` installs one.

`python -I benchmarks/peer_jax.py DATA.npz SETTINGS [--lanes 5] [--threads 2] [--device cpu]`. This
is the program that somebody in a hurry writes instead of using this project: one pure function per
update, `vmap` over lanes, `scan` over updates, Adam of optax, everything drawn on the device. The
equations, sizes and rates are those of our learners past their warm-ups, the transitions the same
table of whole histories. CQL computes the first layer's product with an observation once for all
actions tried there, as ours does, so the comparison is one of programs and not of that trick.

XLA has no setting for its threads on a CPU: it takes as many as there are processors that it may
run on, so the process is bound to the first of them. Precision is JAX's default, on a GPU that has
it TF32. For a GPU install `jax[cuda13]` (or `jax[cuda12]`) of the same version into .venv-peers.

With `--check GIVEN.npz FOUND.npz` nothing is timed: updates on given weights, batches and draws are
written, for a comparison with ours. Nothing of this project is imported here. The last line of the
standard output is the answer as JSON: seconds per timing, updates of each, version.
"""

import argparse
import itertools
import json
import os
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax, random

_CHUNK = {"cpu": {"td3_bc": 20, "cql": 2}, "gpu": {"td3_bc": 500, "cql": 100}}  # updates per scan
_LOG_STD_RANGE = (-5.0, 2.0)

State = dict[str, Any]  # networks, their targets and Adam's moments, all of one lane


def network(key: Any, widths: list[int]) -> list[Any]:
    """Layers of weight `[in, out]` and bias `[out]`, PyTorch's initial numbers."""
    layers = []
    for inputs, outputs in itertools.pairwise(widths):
        key, own = random.split(key)
        bound = inputs**-0.5
        drawn = random.uniform(own, (inputs + 1, outputs), minval=-bound, maxval=bound)
        layers.append((drawn[:-1], drawn[-1]))
    return layers


def mlp(layers: list[Any], x: Any) -> Any:
    """Outputs `[B, out]`."""
    *hidden, (weight, bias) = layers
    for inner_weight, inner_bias in hidden:
        x = jax.nn.relu(x @ inner_weight + inner_bias)
    return x @ weight + bias


def over_actions(layers: list[Any], seen: Any, actions: Any) -> Any:
    """Values `[B, N]` of actions `[B, N, A]`."""
    (weight, bias), *rest = layers
    width = seen.shape[-1]
    x = (seen @ weight[:width] + bias)[:, None] + actions @ weight[width:]
    return mlp(rest, jax.nn.relu(x))[..., 0]


def values(critics: Any, seen: Any, actions: Any) -> Any:
    """Values `[2, B]`."""
    pairs = jnp.concatenate([seen, actions], axis=-1)
    return jax.vmap(mlp, (0, None))(critics, pairs)[..., 0]


def gaussian(actor: Any, seen: Any) -> tuple[Any, Any]:
    """Mean and log standard deviation before the tanh, `[B, A]` each."""
    mean, log_std = jnp.split(mlp(actor, seen), 2, axis=-1)
    return mean, jnp.clip(log_std, *_LOG_STD_RANGE)


def sample(parameters: tuple[Any, Any], noise: Any) -> tuple[Any, Any]:
    """Actions `[B, N, A]` and their log densities `[B, N]`."""
    mean, log_std = (p[:, None] for p in parameters)
    raw = mean + jnp.exp(log_std) * noise
    normal = -0.5 * jnp.square(noise) - log_std - 0.5 * jnp.log(2.0 * jnp.pi)
    squashing = 2.0 * (jnp.log(2.0) - raw - jax.nn.softplus(-2.0 * raw))
    return jnp.tanh(raw), (normal - squashing).sum(axis=-1)


class Learner:
    """What both algorithms share. `settings` are those of ours, with its name as `algorithm`."""

    outputs = 1  # of the actor, per entry of an action

    def __init__(self, settings: Mapping[str, Any]) -> None:
        self.settings = settings
        rate = settings["learning_rate"]
        self.adams = {
            "critics": optax.adam(rate),
            "actor": optax.adam(settings.get("actor_learning_rate", rate)),
        }

    def start(self, key: Any, seen: int, acted: int) -> State:
        """A fresh lane."""
        own, first, second = random.split(key, 3)
        hidden = self.settings["hidden"]
        actor = network(own, [seen, *hidden, self.outputs * acted])
        twins = [network(k, [seen + acted, *hidden, 1]) for k in (first, second)]
        critics = jax.tree.map(lambda a, b: jnp.stack([a, b]), *twins)
        return self.begin({"actor": actor, "critics": critics})

    def begin(self, networks: State) -> State:
        """Targets and moments of fresh networks."""
        state = networks | {"critics_target": networks["critics"]}
        for name in ("actor", "critics"):
            state |= {f"{name}_adam": self.adams[name].init(networks[name])}
        return state

    def step(self, state: State, name: str, gradient: Any) -> State:
        """One step of Adam."""
        change, moments = self.adams[name].update(gradient, state[f"{name}_adam"])
        return state | {name: optax.apply_updates(state[name], change), f"{name}_adam": moments}

    def follow(self, state: State, name: str) -> State:
        """Move a target towards its network."""
        rate, target = self.settings["target_rate"], f"{name}_target"
        moved = jax.tree.map(lambda t, x: t + rate * (x - t), state[target], state[name])
        return state | {target: moved}

    def target(self, state: State, batch: State, actions: Any) -> Any:
        """Bootstrapped values `[B]` with these actions in the next states."""
        least = values(state["critics_target"], batch["next_observations"], actions).min(axis=0)
        return batch["rewards"] + self.settings["discount"] * batch["continues"] * least


class TD3BC(Learner):
    """Fujimoto and Gu 2021, as in the authors' code."""

    def begin(self, networks: State) -> State:
        return super().begin(networks) | {"actor_target": networks["actor"]}

    def draw(self, key: Any, acted: int) -> State:
        return {"noise": random.normal(key, (self.settings["batch"], acted))}

    def update(self, state: State, batch: State, drawn: State, with_actor: bool) -> State:
        """One update of the critics; where due, of the actor and all targets."""
        of, seen = self.settings, batch["observations"]
        clip = of["smoothing_clip"]
        noise = jnp.clip(of["smoothing"] * drawn["noise"], -clip, clip)
        chosen = jnp.tanh(mlp(state["actor_target"], batch["next_observations"])) + noise
        target = self.target(state, batch, jnp.clip(chosen, -1.0, 1.0))

        def critic_loss(critics: Any) -> Any:
            errors = values(critics, seen, batch["actions"]) - target
            return jnp.square(errors).mean(axis=1).sum()

        state = self.step(state, "critics", jax.grad(critic_loss)(state["critics"]))
        if not with_actor:
            return state
        first = jax.tree.map(lambda x: x[0], state["critics"])

        def actor_loss(actor: Any) -> Any:
            actions = jnp.tanh(mlp(actor, seen))
            value = mlp(first, jnp.concatenate([seen, actions], axis=-1))[:, 0]
            scale = of["alpha"] / lax.stop_gradient(jnp.abs(value).mean())
            return jnp.square(actions - batch["actions"]).mean() - scale * value.mean()

        state = self.step(state, "actor", jax.grad(actor_loss)(state["actor"]))
        return self.follow(self.follow(state, "actor"), "critics")


class CQL(Learner):
    """Kumar et al. 2020: CQL(H) past its warm-up, without a learned multiplier."""

    outputs = 2

    def __init__(self, settings: Mapping[str, Any]) -> None:
        super().__init__(settings)
        self.adams["log_temperature"] = self.adams["actor"]

    def begin(self, networks: State) -> State:
        nothing = jnp.zeros(())
        moments = self.adams["log_temperature"].init(nothing)
        fresh = {"log_temperature": nothing, "log_temperature_adam": moments}
        return super().begin(networks) | fresh

    def draw(self, key: Any, acted: int) -> State:
        actor, target, here, ahead, uniform = random.split(key, 5)
        size = self.settings["batch"]
        several = (size, self.settings["tried_actions"], acted)
        return {
            "actor": random.normal(actor, (size, 1, acted)),
            "target": random.normal(target, (size, 1, acted)),
            "here": random.normal(here, several),
            "next": random.normal(ahead, several),
            "uniform": random.uniform(uniform, several, minval=-1.0),
        }

    def update(self, state: State, batch: State, drawn: State, with_actor: bool) -> State:
        """One update of temperature, actor, critics and target."""
        seen, acted = batch["observations"], batch["actions"].shape[-1]
        _, density = sample(gaussian(state["actor"], seen), drawn["actor"])
        state = self.step(state, "log_temperature", acted - density.mean())
        temperature = jnp.exp(state["log_temperature"])

        def actor_loss(actor: Any) -> Any:
            actions, density = sample(gaussian(actor, seen), drawn["actor"])
            least = values(state["critics"], seen, actions[:, 0]).min(axis=0)
            return temperature * density.mean() - least.mean()

        state = self.step(state, "actor", jax.grad(actor_loss)(state["actor"]))
        following = gaussian(state["actor"], batch["next_observations"])
        target = self.target(state, batch, sample(following, drawn["target"])[0][:, 0])
        tried, densities = self.tried(state["actor"], seen, following, drawn)
        actions = jnp.concatenate([batch["actions"][:, None], tried], axis=1)

        def critic_loss(critics: Any) -> Any:
            value = jax.vmap(over_actions, (0, None, None))(critics, seen, actions)  # [2, B, 1+3N]
            logged = value[..., 0]
            pushed = jax.nn.logsumexp(value[..., 1:] - densities, axis=-1)
            gap = self.settings["weight"] * (pushed - logged).mean(axis=1)
            return (jnp.square(logged - target).mean(axis=1) + gap).sum()

        state = self.step(state, "critics", jax.grad(critic_loss)(state["critics"]))
        return self.follow(state, "critics")

    def tried(self, actor: Any, seen: Any, following: Any, drawn: State) -> tuple[Any, Any]:
        """Uniform, own and next actions `[B, 3N, A]` and their log densities `[B, 3N]`."""
        here, here_density = sample(gaussian(actor, seen), drawn["here"])
        ahead, ahead_density = sample(following, drawn["next"])
        uniform = drawn["uniform"]
        uniform_density = jnp.full(here_density.shape, -uniform.shape[-1] * np.log(2.0))
        densities = [uniform_density, here_density, ahead_density]
        return jnp.concatenate([uniform, here, ahead], 1), jnp.concatenate(densities, 1)


_LEARNERS = {"td3_bc": TD3BC, "cql": CQL}


def _place(threads: int, device: str) -> None:
    """Bind this process to its processors and choose the platform, before XLA starts."""
    if device == "cpu" and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:threads])
    jax.config.update("jax_platforms", device)


def _measure(options: argparse.Namespace) -> dict[str, Any]:
    """Time scans of updates on all lanes."""
    settings = options.settings
    algorithm = settings["algorithm"]
    learner = _LEARNERS[algorithm](settings)
    with np.load(options.data, allow_pickle=False) as stored:
        log = {
            name: jnp.asarray(stored[name].astype(np.float32))
            for name in ("observations", "actions", "rewards", "next_observations", "terminals")
        }
    log["continues"] = 1.0 - log.pop("terminals")
    count, seen = log["observations"].shape
    acted = log["actions"].shape[1]
    every = settings.get("actor_every", 1)
    chunk = _CHUNK["cpu" if options.device == "cpu" else "gpu"][algorithm]
    chunk = -(-chunk // every) * every

    def some(carried: tuple[Any, Any], _: None) -> tuple[tuple[Any, Any], None]:
        state, key = carried
        for number in range(every):
            key, rows, noise = random.split(key, 3)
            index = random.randint(rows, (settings["batch"],), 0, count)
            batch = {name: whole[index] for name, whole in log.items()}
            state = learner.update(state, batch, learner.draw(noise, acted), number == every - 1)
        return (state, key), None

    keys = random.split(random.key(0), (2, options.lanes))
    carried = jax.vmap(lambda k: learner.start(k, seen, acted))(keys[0]), keys[1]
    scan = jax.vmap(lambda state: lax.scan(some, state, None, length=chunk // every)[0])
    run = jax.jit(scan)
    begin = time.perf_counter()
    carried = jax.block_until_ready(run(carried))
    compiled = time.perf_counter() - begin
    begin = time.perf_counter()
    carried = jax.block_until_ready(run(carried))
    once = time.perf_counter() - begin
    calls = max(1, round(options.seconds / options.repetitions / once))
    timings = []
    for _ in range(options.repetitions):
        begin = time.perf_counter()
        for _ in range(calls):
            carried = run(carried)
        jax.block_until_ready(carried)
        timings.append(time.perf_counter() - begin)
    return {"timings": timings, "updates": calls * chunk, "compile_seconds": compiled}


def _check(settings: Mapping[str, Any], given: Path, found: Path) -> None:
    """Compute updates from given weights, batches and draws, all lane-first; store the networks.

    Names are `actor/0/weight`, `critics/0/bias` and so on, critics with a second axis of two;
    `batch/NUMBER/NAME` and `draw/NUMBER/NAME` belong to update NUMBER.
    """
    learner = _LEARNERS[settings["algorithm"]](settings)
    with np.load(given, allow_pickle=False) as stored:
        arrays = {name: jnp.asarray(stored[name]) for name in stored.files}
    layers = len(settings["hidden"]) + 1
    networks = {
        name: [(arrays[f"{name}/{i}/weight"], arrays[f"{name}/{i}/bias"]) for i in range(layers)]
        for name in ("actor", "critics")
    }
    state = jax.vmap(learner.begin)(networks)
    every = settings.get("actor_every", 1)
    for number in range(sum(name.startswith("batch/") for name in arrays) // 5):
        batch, drawn = (
            {
                name.split("/")[2]: array
                for name, array in arrays.items()
                if name.startswith(f"{kind}/{number}/")
            }
            for kind in ("batch", "draw")
        )
        update = partial(learner.update, with_actor=(number + 1) % every == 0)
        state = jax.jit(jax.vmap(update))(state, batch, drawn)
    result = {}
    for name in ("actor", "critics", "critics_target"):
        for i, (weight, bias) in enumerate(state[name]):
            result |= {f"{name}/{i}/weight": np.asarray(weight), f"{name}/{i}/bias": bias}
    np.savez(found, **result)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("settings", type=json.loads, help="JSON: algorithm and its settings")
    parser.add_argument("--lanes", type=int, default=1)
    parser.add_argument("--threads", type=int, default=2, help="processors, on a CPU")
    parser.add_argument("--seconds", type=float, default=3.0, help="of all timings together")
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--check", type=Path, help="where to store the networks after updates")
    options = parser.parse_args()
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    _place(options.threads, options.device)
    if options.check is not None:
        _check(options.settings, options.data, options.check)
        answer: dict[str, Any] = {}
    else:
        answer = _measure(options)
    device = jax.devices()[0].device_kind
    print(json.dumps(answer | {"program": f"JAX {jax.__version__}", "device": device}))


if __name__ == "__main__":
    main()
