"""Adam for named groups of tensors: what ``torch.optim.Adam(fused=True)`` computes and stores, without that class.

The first use of the class imports torch's compiler, which takes seconds and compiles nothing here
(design/reconstruction.md). The arithmetic is torch's own function.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.optim.adam import adam

MOMENTS = ("exp_avg", "exp_avg_sq")
OPTIONS: dict[str, Any] = dict.fromkeys(("amsgrad", "maximize", "capturable", "differentiable"), False)
OPTIONS |= {"weight_decay": 0, "foreach": None, "fused": True}  # of torch's function, as they are used here


class Adam:
    """Tensors in groups, and ``state``: per tensor its step and both moments, from its first step on."""

    def __init__(self, groups: Mapping[str, Iterable[Tensor]], betas: tuple[float, float], epsilon: float):
        """Remember nothing yet; arguments as those of torch's class, tensors by name of their group."""
        self.groups = {name: list(tensors) for name, tensors in groups.items()}
        self.rates = dict.fromkeys(self.groups, 0.0)
        self.betas, self.epsilon = betas, epsilon
        self.state: dict[Tensor, dict[str, Tensor]] = {}

    @property
    def tensors(self) -> list[Tensor]:
        """Of all groups."""
        return [tensor for group in self.groups.values() for tensor in group]

    @torch.no_grad()
    def step(self, gradients: Iterable[Tensor | None], rates: Mapping[str, float]) -> None:
        """One step, in place.

        Args:
            gradients: Of ``tensors``; None leaves one alone, its moments included.
            rates: By name of the group; 0 leaves all of it alone.
        """
        given = dict(zip(self.tensors, gradients, strict=True))
        for name, group in self.groups.items():
            self.rates[name] = rates[name]
            if rates[name] == 0.0:
                continue
            # torch's fused step reads a gradient as if it were contiguous, and a slice of another one is not
            present = [(t, gradient.contiguous()) for t in group if (gradient := given[t]) is not None]
            if not present:
                continue
            states = [self.remembered(tensor) for tensor, _ in present]
            steps = [state["step"] for state in states]
            first, second = ([state[moment] for state in states] for moment in MOMENTS)
            hyper: dict[str, Any] = {
                "lr": rates[name],
                "beta1": self.betas[0],
                "beta2": self.betas[1],
                "eps": self.epsilon,
            }
            adam([t for t, _ in present], [g for _, g in present], first, second, [], steps, **hyper, **OPTIONS)

    def remembered(self, tensor: Tensor) -> dict[str, Tensor]:
        """Step and moments of a tensor; zeros, from now on, if there are none yet."""
        if tensor not in self.state:
            step = torch.zeros((), device=tensor.device)
            self.state[tensor] = {"step": step} | {name: torch.zeros_like(tensor) for name in MOMENTS}
        return self.state[tensor]

    def put(self, name: str, new: Tensor, state: dict[str, Tensor] | None) -> None:
        """Let another tensor take the place of the only one of a group, and this be its state; None: none yet."""
        (old,) = self.groups[name]
        self.state.pop(old, None)
        self.groups[name] = [new]
        if state is not None:
            self.state[new] = state

    def state_dict(self) -> dict[str, Any]:
        """What torch's class stores: tensors are numbers in the order of the groups; nothing is copied."""
        numbers = {tensor: n for n, tensor in enumerate(self.tensors)}
        shared = {"betas": self.betas, "eps": self.epsilon, **OPTIONS, "decoupled_weight_decay": False}
        groups = [
            {"name": name, "lr": self.rates[name], **shared, "params": [numbers[tensor] for tensor in group]}
            for name, group in self.groups.items()
        ]
        return {"state": {numbers[tensor]: state for tensor, state in self.state.items()}, "param_groups": groups}

    def load_state_dict(self, stored: Mapping[str, Any]) -> None:
        """Take over rates, decays and state from :meth:`state_dict`, or from that of torch's class.

        Raises:
            ValueError: If the groups are others.
        """
        groups, tensors, self.state = stored["param_groups"], self.tensors, {}
        sizes = {name: len(group) for name, group in self.groups.items()}
        if sizes != (found := {group["name"]: len(group["params"]) for group in groups}):
            raise ValueError(f"tensors per group are {found}, not {sizes}")
        self.rates = {group["name"]: group["lr"] for group in groups}
        self.betas, self.epsilon = tuple(groups[0]["betas"]), groups[0]["eps"]
        for n, state in stored["state"].items():
            self.state[tensors[n]] = {name: value.to(tensors[n].device) for name, value in state.items()}
