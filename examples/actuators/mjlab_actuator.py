"""An exported actuator in mjlab: a PD actuator that follows effective targets."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from effective import EffectiveTarget
from mjlab.actuator import ActuatorCmd, IdealPdActuator, IdealPdActuatorCfg
from torch import Tensor


@dataclass(kw_only=True)
class RetwinActuatorCfg(IdealPdActuatorCfg):
    """Its configuration, see `EffectiveTarget`."""

    file: str
    unit: float = 1.0
    zero: float = 0.0

    def build(self, entity: Any, target_ids: list[int], target_names: list[str]) -> RetwinActuator:
        """The actuator."""
        return RetwinActuator(self, entity, target_ids, target_names)


class RetwinActuator(IdealPdActuator):
    """The actuator; stiffness and damping are those of the simulated joint drive."""

    cfg: RetwinActuatorCfg

    def initialize(self, mj_model: Any, model: Any, data: Any, device: str) -> None:
        """Read the file for all worlds."""
        super().initialize(mj_model, model, data, device)
        self.effective = EffectiveTarget(
            self.cfg.file, data.nworld, unit=self.cfg.unit, zero=self.cfg.zero, device=device
        )

    def reset(self, env_ids: Tensor | slice | None = None) -> None:
        """Begin episodes with new draws."""
        super().reset(env_ids)
        self.effective.reset(env_ids)

    def compute(self, cmd: ActuatorCmd) -> Tensor:
        """The torques towards what the real actuators would follow."""
        return super().compute(
            replace(cmd, position_target=self.effective(cmd.position_target, cmd.pos))
        )
