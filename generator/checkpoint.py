"""Checkpoints: everything that a training needs to go on as if it had not stopped."""

from __future__ import annotations

import io
import random
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import TD3

from racecar.controller import write_whole
from racecar.errors import BadInput

#: What of a replay buffer is kept: the rows that are filled.
_ROWS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
_SAVED = ("_last_obs", "_last_episode_starts", "_episode_num", "_n_updates", "num_timesteps")


def save_checkpoint(
    model: TD3, curve: list[dict[str, float]], settings: dict[str, Any], path: Path
) -> None:
    """Write networks, optimisers, replay buffer, environment and random generators.

    settings: what the training was asked to do; it must be the same when it goes on.
    """
    content = io.BytesIO()
    buffer = model.replay_buffer
    assert buffer is not None
    torch.save(
        {
            "settings": settings,
            "policy": model.policy.state_dict(),
            "optimizers": [model.actor.optimizer.state_dict(), model.critic.optimizer.state_dict()],
            "fields": {name: getattr(model, name, None) for name in _SAVED},
            "episodes": list(model.ep_info_buffer or ()),
            # As tensors, which torch writes as they lie in memory: a full scan's are 0.5 GB.
            "buffer": {
                name: torch.from_numpy(getattr(buffer, name)[: buffer.size()]) for name in _ROWS
            },
            "buffer_place": (buffer.pos, buffer.full),
            "env": model.get_env(),
            # SB3 draws from the global generators.
            "random": (random.getstate(), np.random.get_state(), torch.get_rng_state()),  # noqa: NPY002
            "spaces": model.action_space,
            "curve": curve,
        },
        content,
    )
    write_whole(path, content.getbuffer())


def restore_checkpoint(model: TD3, settings: dict[str, Any], path: Path) -> list[dict[str, float]]:
    """Bring a fresh model to the state of a checkpoint; return the learning curve so far.

    Raises BadInput if the file is broken or of a training with other settings.
    """
    try:
        # Our own file; it holds whole Python objects.
        state = torch.load(path, weights_only=False)
        if state["settings"] != settings:
            raise BadInput(
                f"{path.parent}: its training was begun with other hyper-parameters, timesteps or "
                "libraries; choose another --work or remove it"
            )
        model.policy.load_state_dict(state["policy"])
        buffer = model.replay_buffer
        assert buffer is not None
        for name in _ROWS:
            rows = state["buffer"][name].numpy()
            getattr(buffer, name)[: len(rows)] = rows
        buffer.pos, buffer.full = state["buffer_place"]
    except BadInput:
        raise
    except Exception:  # unpickling raises whatever it likes
        raise BadInput(f"{path}: not a checkpoint of this version; remove it") from None
    model.actor.optimizer.load_state_dict(state["optimizers"][0])
    model.critic.optimizer.load_state_dict(state["optimizers"][1])
    model.set_env(state["env"], force_reset=False)
    model.action_space = state["spaces"]
    for name, value in state["fields"].items():
        setattr(model, name, value)
    model._setup_learn(0, reset_num_timesteps=False)  # makes the episode buffers
    assert model.ep_info_buffer is not None
    model.ep_info_buffer.extend(state["episodes"])
    random.setstate(state["random"][0])
    np.random.set_state(state["random"][1])  # noqa: NPY002
    torch.set_rng_state(state["random"][2])
    curve: list[dict[str, float]] = state["curve"]
    return curve
