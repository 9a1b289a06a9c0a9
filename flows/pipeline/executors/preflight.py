"""Asks a cluster whether it lets us in and is of our kind, before Ray itself tries for minutes."""

import contextlib
import json
import os
import platform
from collections.abc import Iterator, Mapping
from typing import Any

from flows.pipeline.errors import PipelineError

__all__ = ["check_admission"]

_PATIENCE = 10.0  # seconds for one answer


def check_admission(ray: Any, address: str) -> None:
    """Finds a missing or wrong token, and other versions, in an instant.

    Only the usual `host:port` is asked, and only what Ray's inner interface of today answers;
    everything else is left to `ray.init`.

    Args:
        ray: The module, not connected.
        address: RAY_ADDRESS.

    Raises:
        PipelineError: the cluster refuses our token, or is of another Ray or Python.
    """
    if not address.rpartition(":")[2].isdigit() or "://" in address:
        return
    try:
        described = _described(ray, address)
    except ray.exceptions.AuthenticationError:
        raise PipelineError(
            f"The cluster at RAY_ADDRESS={address} asks for a token, and {_token_here(ray)}: give "
            "this command the cluster's own, as RAY_AUTH_TOKEN or as the file ~/.ray/auth_token "
            "or the one that RAY_AUTH_TOKEN_PATH names, with RAY_AUTH_MODE=token (on the "
            "cluster's head `ray get-auth-token` prints it)."
        ) from None
    except Exception:  # whatever else is wrong, ray.init finds it, too
        return
    ours = {"ray_version": ray.__version__, "python_version": platform.python_version()}
    names = {"ray_version": "Ray", "python_version": "Python"}
    other = [n for n in ours if _compared(described.get(n, ours[n])) != _compared(ours[n])]
    if other:
        theirs = " and ".join(f"{names[name]} {described[name]}" for name in other)
        here = " and ".join(f"{names[name]} {ours[name]}" for name in other)
        raise PipelineError(
            f"The cluster at RAY_ADDRESS={address} runs {theirs}, this command {here}: start it "
            "from the same versions on the cluster, or use an environment with the cluster's."
        )


def _compared(version: str) -> str:
    """The part of a version in which Ray wants two to agree."""
    whole = os.environ.get("RAY_DEFAULT_PYTHON_VERSION_MATCH_LEVEL", "patch") == "patch"
    return version if whole else ".".join(version.split(".")[:2])


def _described(ray: Any, address: str) -> Mapping[str, Any]:
    """What the cluster's head tells of itself; nothing if this Ray cannot be asked so."""
    try:
        from ray._common.usage.usage_constants import CLUSTER_METADATA_KEY
        from ray._private.authentication import authentication_token_setup
        from ray._private.ray_constants import KV_NAMESPACE_CLUSTER
        from ray._raylet import GcsClient
    except ImportError:
        return {}
    # As `ray.init` does: a token that lies there is used.
    authentication_token_setup.maybe_enable_token_auth_if_token_available(warn_if_disabled=False)
    with _native_silence():
        client = GcsClient(address=address)
        answer = client.internal_kv_get(CLUSTER_METADATA_KEY, KV_NAMESPACE_CLUSTER, _PATIENCE)
    value = json.loads(answer or b"{}")
    return value if isinstance(value, dict) else {}


def _token_here(ray: Any) -> str:
    """What this process has to show, in words."""
    if os.environ.get("RAY_AUTH_MODE", "token").lower() != "token":
        return f"RAY_AUTH_MODE={os.environ['RAY_AUTH_MODE']} keeps this command from showing one"
    for name in ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"):
        if os.environ.get(name):
            return f"the one in {name} is not it"
    if os.path.exists(os.path.expanduser("~/.ray/auth_token")):
        return "the one in ~/.ray/auth_token is not it"
    return "this command has none"


@contextlib.contextmanager
def _native_silence() -> Iterator[None]:
    """Keeps native code from writing to stderr: what it has to say is raised as well."""
    with contextlib.ExitStack() as undone:
        try:
            kept = os.dup(2)
        except OSError:  # there is no stderr
            yield
            return
        undone.callback(os.close, kept)
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        undone.callback(os.dup2, kept, 2)
        yield
