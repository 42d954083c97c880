"""A Python program that reads every vehicle's state at every step of SUMO, through libsumo or TraCI.

It reads the same fields as `traffic-bridge/src/sumo/shim.cc` on a flat net, and reads them as often. It leaves out
traffic lights and the fields that are read once at a departure. Like `traffic-bridge`, it updates the list of live
vehicles from departures and arrivals.
"""

import time
from dataclasses import dataclass, field
from types import ModuleType

from caraware_bench.cost import LoopCost, cpu_s

SIGNAL_PERIOD_STEPS = 4
"""Each vehicle's signals are read once in this many steps."""

State = tuple[float, float, float, float, float]
"""x, y, z in metres of the net, SUMO's angle in degrees, speed in m/s."""


@dataclass
class Mirror:
    """The last known state of every vehicle on the road; `sumo` is the module libsumo or traci."""

    sumo: ModuleType
    states: dict[str, State] = field(default_factory=dict)
    signals: dict[str, int] = field(default_factory=dict)
    steps: int = 0

    def step(self) -> int:
        """Make a step of SUMO and read every vehicle; return the number of vehicles."""
        self.sumo.simulationStep()
        for vehicle in self.sumo.simulation.getArrivedIDList():
            self.states.pop(vehicle, None)
            self.signals.pop(vehicle, None)
        for vehicle in self.sumo.simulation.getDepartedIDList():
            self.states[vehicle] = (0.0, 0.0, 0.0, 0.0, 0.0)
        self.read()
        self.steps += 1
        return len(self.states)

    def read(self) -> None:
        """Call the getters of all vehicles once."""
        get = self.sumo.vehicle
        position, angle, speed, signals = get.getPosition3D, get.getAngle, get.getSpeed, get.getSignals
        for index, vehicle in enumerate(self.states):
            self.states[vehicle] = (*position(vehicle), angle(vehicle), speed(vehicle))
            if (self.steps + index) % SIGNAL_PERIOD_STEPS == 0:
                self.signals[vehicle] = signals(vehicle)


def measure(sumo: ModuleType, arguments: list[str], steps: int) -> LoopCost:
    """The cost of the first `steps` steps with SUMO's own time, its process's included, and without loading."""
    sumo.start(arguments)
    try:
        mirror = Mirror(sumo)
        cpu_before_s, begin = cpu_s(), time.perf_counter()
        updates = sum(mirror.step() for _ in range(steps))
        wall_s = time.perf_counter() - begin
        return LoopCost(updates, wall_s, cpu_s() - cpu_before_s)
    finally:
        sumo.close()
