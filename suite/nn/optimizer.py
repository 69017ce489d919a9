"""What optimizers of several networks share."""

from __future__ import annotations

import optax


def clipped(optimizer: optax.GradientTransformation, max_grad_norm: float) -> optax.GradientTransformation:
    """The optimizer, which sees gradients whose global norm is clipped to `max_grad_norm` first (fidelity note 23)."""
    return optax.chain(optax.clip_by_global_norm(max_grad_norm), optimizer)
