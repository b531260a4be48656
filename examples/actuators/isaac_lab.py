"""An exported actuator in Isaac Lab: a PD actuator that follows effective targets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import MISSING
from typing import Any

from effective import EffectiveTarget
from isaaclab.actuators import IdealPDActuator, IdealPDActuatorCfg
from isaaclab.utils import configclass
from torch import Tensor


class RetwinActuator(IdealPDActuator):
    """The actuator; stiffness and damping are those of the simulated joint drive."""

    cfg: RetwinActuatorCfg

    def __init__(self, cfg: RetwinActuatorCfg, *args: Any, **kwargs: Any) -> None:
        super().__init__(cfg, *args, **kwargs)
        self.effective = EffectiveTarget(
            cfg.file, self._num_envs, unit=cfg.unit, zero=cfg.zero, device=self._device
        )

    def reset(self, env_ids: Sequence[int]) -> None:
        """Begin episodes with new draws."""
        super().reset(env_ids)
        self.effective.reset(env_ids)

    def compute(self, control_action: Any, joint_pos: Tensor, joint_vel: Tensor) -> Any:
        """The torques towards what the real actuators would follow."""
        control_action.joint_positions = self.effective(control_action.joint_positions, joint_pos)
        return super().compute(control_action, joint_pos, joint_vel)


@configclass
class RetwinActuatorCfg(IdealPDActuatorCfg):
    """Its configuration, see `EffectiveTarget`."""

    class_type: type = RetwinActuator
    file: str = MISSING  # type: ignore[assignment]
    unit: float = 1.0
    zero: float = 0.0
