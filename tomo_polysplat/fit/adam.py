"""Adam (Kingma and Ba 2015, arXiv:1412.6980) as torch's kernel has it.

torch's class of the same name loads torch's compiler when one is made, which takes more than a second. Its function
looks over all parameters before it calls the kernel, which takes several times as long as that for a small cloud.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch

__all__ = ["Adam", "Moments", "new_moments"]

# So small that gradients of any unit give the same steps.
EPSILON = 1e-15
_FIRST_DECAY, _SECOND_DECAY = 0.9, 0.999

# First and second moment of each parameter by name.
Moments = dict[str, tuple[torch.Tensor, torch.Tensor]]


def new_moments(parameters: Mapping[str, torch.Tensor]) -> Moments:
    """Adam's memory before its first step."""
    return {name: (torch.zeros_like(t), torch.zeros_like(t)) for name, t in parameters.items()}


class Adam:
    """Steps of parameters along the gradients that autograd left in them.

    Parameters
    ----------
    parameters : dict of name to tensor
        Changed in place; they get gradients from now on.

    Attributes
    ----------
    moments : dict of name to (exp_avg, exp_avg_sq)
        To be changed in place only.
    """

    def __init__(self, parameters: Mapping[str, torch.Tensor]) -> None:
        self.parameters = {name: tensor.requires_grad_() for name, tensor in parameters.items()}
        self.moments = new_moments(parameters)
        self._counts = {name: torch.zeros((), device=tensor.device) for name, tensor in parameters.items()}

    def count(self, steps: int) -> None:
        """Go on as after so many steps."""
        for counted in self._counts.values():
            counted.fill_(steps)

    def forget_gradients(self) -> None:
        """Before new ones are made."""
        for tensor in self.parameters.values():
            tensor.grad = None

    @torch.no_grad()
    def step(self, rates: Mapping[str, float]) -> None:
        """One step at these learning rates, by name; a parameter without a gradient stays."""
        slopes = {name: t.grad for name, t in self.parameters.items() if t.grad is not None}
        if not slopes:
            return
        torch._foreach_add_([self._counts[name] for name in slopes], 1)
        for name, slope in slopes.items():
            first, second = self.moments[name]
            torch._fused_adam_(
                [self.parameters[name]],
                [slope],
                [first],
                [second],
                [],
                [self._counts[name]],
                lr=rates[name],
                beta1=_FIRST_DECAY,
                beta2=_SECOND_DECAY,
                weight_decay=0.0,
                eps=EPSILON,
                amsgrad=False,
                maximize=False,
            )
