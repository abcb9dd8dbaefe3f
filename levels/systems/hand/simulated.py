"""The simulated hand: tendons behind valves that follow a tension or are closed."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from rack.levels.algebra import Array, Mask
from rack.levels.arm.sensors import CoarseSensors
from rack.levels.arm.simulation import Simulation
from rack.levels.robot.cell import Cell
from rack.levels.tables import SceneConfig


class HandSample(NamedTuple):
    """One sample of a hand's sensors.

    Positions and velocities have the resolution and noise of their encoders.

    Attributes:
        position: Joint positions, (joints,), rad.
        velocity: Joint velocities, (joints,), rad/s.
        torque: Torques of the tendons, (joints,), N m.
        tension: Tensions of flexors and extensors, (2, joints), N.
        force: Forces of the environment on the tips in the palm's frame, (fingers, 3), N.
    """

    position: Array
    velocity: Array
    torque: Array
    tension: Array
    force: Array


class SimulatedHand(Simulation):
    """A hand driven by tendons.

    It has no brakes: without commands its valves close and keep the grip. The air in a closed valve
    acts as a spring: the joint changes the tension of a tendon by pulling it. Its stiffness is
    `Hand.closed` (1 + `Hand.stiffening` tension). Moving fingers therefore come to rest, and the
    grip is kept by the tension at which the valves closed. Initially the valves are closed, with
    tensions that carry the weight of the open hand.

    If tendons stiffen, they are also springs while the valves are open. The tension loop of a valve
    then returns to the commanded tension with its lag, so that a pair resists quick motion, the
    more the higher its mean tension.
    """

    def __init__(
        self, cell: Cell, scene: SceneConfig, clock_ns: int, every: int = 1, seed: int = 0
    ) -> None:
        """Start in the home position with closed valves.

        Args:
            cell: Cell with a hand.
            scene: Scene with the objects.
            clock_ns: Length of a tick, ns.
            every: Ticks between two commands.
            seed: Seed of the sensor noise.
        """
        super().__init__(cell)
        assert cell.hand is not None, "it is a hand"
        self.hand = hand = cell.hand
        # Ticks without a command after which the valves close.
        self.patience = cell.patience.ticks(every, clock_ns * 1e-9)
        self.waited = self.patience
        self._palm = np.array(self._data.site_xmat[cell.tool]).reshape(3, 3)
        self._set_initial_tensions(_find_carrying_tensions(cell, self._data))
        self.prepare_simulation(scene, clock_ns)
        pull = hand.closed * hand.arms
        self._spring = np.stack((-pull, pull))  # (2, joints), N/rad: of closed valves
        self._coarse = None if cell.encoders.is_exact else CoarseSensors(cell.encoders, seed)
        acts = cell.model.actuator_actadr[hand.actuators]
        # (2, joints): addresses of the states of valves with a lag. None without a lag.
        self._acts = acts if (acts >= 0).all() else None

    def _set_initial_tensions(self, tension: Array) -> None:
        """Set controls, valve states and delay lines to steady tensions, (2, joints), in N."""
        model = self.cell.model
        d = self._data
        for actuator, pull in zip(
            self.hand.actuators.ravel().tolist(), tension.ravel().tolist(), strict=True
        ):
            d.ctrl[actuator] = pull
            if model.actuator_actnum[actuator]:
                d.act[model.actuator_actadr[actuator]] = pull
            samples = model.actuator_history[actuator, 0]
            if samples:
                mujoco.mj_initCtrlHistory(model, d, actuator, None, np.full((samples, 1), pull))
        mujoco.mj_forward(model, d)

    @property
    def commanded_tensions(self) -> Array:
        """Commanded tensions of open valves, or equilibrium tensions of closed ones.

        Its shape is (2, joints), its unit N.
        """
        return np.asarray(np.clip(self._data.ctrl[self.hand.actuators], 0.0, self.hand.most))

    def sense(self) -> HandSample:
        """Return the newest sample.

        Torques, tensions and forces are one simulation step old, as always in MuJoCo.
        """
        position, velocity = self._state
        if self._coarse is not None:
            position, velocity = self._coarse.sample(position, velocity, self.tick)
        tension = self._data.actuator_force[self.hand.actuators]
        force = self._data.sensordata[self.hand.forces]
        in_palm = (force[:, :, None] * self._palm).sum(axis=1)
        return HandSample(position, velocity, self._steps.seen[-1, 2], tension, in_palm)

    def apply_tensions(self, tension: Array) -> None:
        """Open the valves and let them follow `tension`, (2, joints), in N."""
        self.waited = 0
        self.braked = False
        self._data.ctrl[self.hand.actuators] = tension

    def tear_tendons(self, torn: Mask) -> None:
        """Tear the tendons selected by the mask `torn`, (2, joints), and mend all others."""
        self._model.actuator_gainprm[self.hand.actuators, 0] = np.where(torn, 0.0, 1.0)

    def close_valves(self) -> None:
        """Close the valves."""
        self.braked = True

    def step(self, ticks: int) -> None:
        """Simulate `ticks` ticks.

        After a simulation fault the hand stays in its last valid state while time continues.
        """
        self.contact = None
        for _ in range(ticks):
            self.braked = self.braked or self.waited >= self.patience
            self.waited += 1
            if not self.fault:
                self._simulate_tick()
            self.tick += 1
        if self.fault:
            self._data.time = self._now_s

    def _simulate_tick(self) -> None:
        """Simulate one tick. While the tendons are springs, the tensions follow the joints.

        The stored controls may be negative, which MuJoCo clamps to 0. A slack tendon therefore
        becomes tight at the same joint position at which it became slack.
        """
        stiffening = self.hand.stiffening
        if not (self.braked or stiffening):
            super()._simulate_tick()
            return
        position = self._state[0]
        before = position.copy()
        super()._simulate_tick()
        is_lagging = self._acts is not None and not self.braked
        tension = self._data.act[self._acts] if is_lagging else self._data.ctrl[self.hand.actuators]
        drawn = self._spring * (position - before)
        # Exponential in the length, to second order, so that it returns to the same tension.
        drawn *= (1.0 + stiffening * tension) / (1.0 - 0.5 * stiffening * drawn)
        if self.braked:
            self._data.ctrl[self.hand.actuators] += drawn
        if self._acts is not None:
            self._data.act[self._acts] = np.maximum(self._data.act[self._acts] + drawn, 0.0)


def _find_carrying_tensions(cell: Cell, data: mujoco.MjData) -> Array:
    """Return the tensions, (2, joints), in N, that carry the hand's weight initially."""
    hand = cell.hand
    assert hand is not None, "it is a hand"
    turn = (data.qfrc_bias - data.qfrc_passive)[cell.dof] / (2.0 * hand.arms)
    tension = np.stack((hand.rest + turn, hand.rest - turn))  # flexors, extensors
    return np.asarray(np.clip(tension, hand.least, hand.most))
