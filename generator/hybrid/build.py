"""From an instance to its hybrid automaton: the phases of a control period, in order.

    begin -> scan -> look (ray by ray, face by face) -> readings -> network -> drive -> scan ...

The modes that look are shared by all rays: the direction of the ray at work is in variables, and a
mode ``next`` keeps what was found and loads the next direction from a table of jumps.

What can be said with one kind of arithmetic or another (exact functions in resets, or polynomials
only) is left to a dialect: generator.hybrid.native and generator.hybrid.polynomial.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from generator.hybrid.automaton import (
    CLOCK,
    TICK,
    Assignment,
    Automaton,
    Constraint,
    Jump,
    Mode,
    StateVariable,
    Unsafe,
    checked,
    leave,
)
from generator.hybrid.dialect import Dialect, F, S, Sight
from generator.hybrid.disturb import (
    Spoil,
    disturbance_variables,
    refuse_mirrors,
    spoiled,
    start_disturbance,
)
from generator.hybrid.expression import ZERO, Variable, constant
from generator.hybrid.sight import Face, alike, check_walls_unsafe, zones
from generator.hybrid.steps import Step, decide, linked
from racecar.controller import Controller
from racecar.instance import AdvanceData, Instance

#: Index of the control period, from 0.
COUNT = Variable("k")
#: Which kind of hall the car is in, where there are several kinds.
HALL = Variable("hall")
#: Number of the ray that is looked at, from 1.
RAY = Variable("ray")
#: The mode in which a run ends.
DONE = "done"


def build(instance: Instance, controller: Controller, dialect: Dialect) -> Automaton:
    """Return the automaton of an instance in a dialect.

    Raises BadInput where the dialect cannot say the instance.
    """
    return _Builder(instance, controller.rays, dialect, kinds_of_hall(instance)).build()


@dataclass(frozen=True)
class Kinds:
    """Frames that behave the same from there on are of one kind, called by the first of them.

    of: the kind of each frame; met: the kinds that a run can come to, in order.
    """

    of: tuple[int, ...]
    met: tuple[int, ...]

    def name(self, base: str, kind: int) -> str:
        """Return what a mode is called in halls of a kind."""
        return base if len(self.met) == 1 else f"{base}_{self.met.index(kind) + 1}"


def kinds_of_hall(instance: Instance) -> Kinds:
    """Return the kinds of an instance's halls; BadInput if a wall is not unsafe."""
    frames, unsafe = instance.plant.frames, instance.property.unsafe
    check_walls_unsafe(frames, unsafe)
    of = alike(frames, unsafe)
    kind = of[0]
    met: list[int] = []
    # The car changes the frame once in a period at most.
    while kind not in met and len(met) <= instance.steps:
        met.append(kind)
        advance = frames[kind].advance
        if advance is None:
            break
        kind = of[advance.to]
    return Kinds(tuple(of), tuple(met))


def asked(automaton: Automaton, instance: Instance, kinds: Kinds) -> Automaton:
    """Return an automaton with the ID, the start box and the property of an instance.

    It was made for one that differs in nothing else; kinds: of both instances' halls.
    """
    box = instance.initial_set
    given = {"s": box.s, "f": box.f, "v": box.v, automaton.heading: box.theta}
    unsafe = tuple(
        Unsafe(
            kinds.name("drive", kind),
            tuple(Constraint(a_s * S + a_f * F, "<=", b) for a_s, a_f, b in polygon),
        )
        for kind in kinds.met
        for polygon in instance.property.unsafe[kind]
    )
    return replace(
        automaton,
        name=instance.id,
        description=f"{instance.controller.name}, {instance.steps} control periods, "
        f"property {instance.property.name}",
        initial=automaton.initial | given,
        unsafe=unsafe,
    )


class _Builder:
    def __init__(self, instance: Instance, rays: int, dialect: Dialect, kinds: Kinds) -> None:
        self.instance, self.rays, self.dialect = instance, rays, dialect
        self.halls = kinds
        self.classes, self.kinds, self._name = kinds.of, kinds.met, kinds.name
        spoil = instance.disturbance
        refuse_mirrors(instance)
        self.spoil = spoil and Spoil(spoil, rays, instance.plant.lidar.range, instance.plant.width)
        self.modes: list[Mode] = []
        self.jumps: list[Jump] = []
        self.looks = 0

    def build(self) -> Automaton:
        """Put the phases together."""
        first = self._entry(self.classes[0])
        steps = [*self.dialect.start()]
        if self.spoil:
            steps += start_disturbance(self.spoil)
        if not steps:
            steps = [Step(Mode("begin", "the run begins"))]
        self._append(steps, first, [])
        work = self._work()
        for kind in self.kinds:
            self._look(kind, work[0].mode.name)
        self._append(work, None, [])
        drives = [self._drive(kind) for kind in self.kinds]
        for drive in drives:
            for guard, reset in work[-1].branches:
                self.jumps.append(
                    leave(
                        work[-1].mode,
                        drive.name,
                        (*guard, *self._in_kind(self.kinds[drives.index(drive)])),
                        (*reset, *self.dialect.enter_drive()),
                    )
                )
        for kind, drive in zip(self.kinds, drives, strict=True):
            self._end_period(kind, drive)
        self.modes += [*drives, Mode(DONE, "the horizon is over")]
        variables = self._variables()
        count = self.instance.steps
        seconds = {step.mode.name: step.mode.dwell for step in (*steps, *work)}
        automaton = Automaton(
            self.instance.id,
            "",
            tuple(variables),
            tuple(Mode(m.name, m.description, m.flow | TICK, m.dwell) for m in self.modes),
            tuple(self.jumps),
            steps[0].mode.name,
            {},
            self.dialect.heading(),
            (),
            sum(seconds[step.mode.name] for step in steps)
            + count * (sum(seconds[s.mode.name] for s in work) + self.instance.plant.period),
            len(steps) + count * (3 + len(self.dialect.prepare()) + self.looks + len(work)),
        )
        zero = dict.fromkeys((variable.name for variable in variables), 0.0)
        start = {name: (x, x) for name, x in (zero | self.dialect.begin()).items()}
        return checked(asked(replace(automaton, initial=start), self.instance, self.halls))

    def _in_kind(self, kind: int) -> tuple[Constraint, ...]:
        if len(self.kinds) == 1:
            return ()
        index = self.kinds.index(kind)
        return (Constraint(HALL, ">=", index - 0.5), Constraint(HALL, "<=", index + 0.5))

    def _entry(self, kind: int) -> str:
        """Return the mode in which a control period begins."""
        if self.spoil and self.spoil.asks_turn:
            return self._name("turn", kind)
        return self._scan(kind)

    def _scan(self, kind: int) -> str:
        """Return the mode with which a scan begins."""
        scan = self._name("scan", kind)
        before = self._copied(self.dialect.prepare(), f"_{scan}")
        return before[0].mode.name if before else scan

    @staticmethod
    def _copied(steps: Sequence[Step], suffix: str) -> list[Step]:
        """Return the steps with modes of their own."""
        return [replace(s, mode=replace(s.mode, name=s.mode.name + suffix)) for s in steps]

    def _append(self, steps: Sequence[Step], target: str | None, reset: Sequence) -> None:
        modes, jumps = linked(steps, target, reset)
        self.modes += modes
        self.jumps += jumps

    def _look(self, kind: int, seen: str) -> None:
        """Add the modes that find what each ray meets first."""
        scan = Mode(self._name("scan", kind), "a scan begins")
        if self.spoil and self.spoil.asks_turn:
            turn = Mode(self._name("turn", kind), "is the car in the turn?")
            self.modes.append(turn)
            self.jumps += self.spoil.ask_turn(turn, self._scan(kind), S, F)
        before = self._copied(self.dialect.prepare(), f"_{self._name('scan', kind)}")
        self._append(before, scan.name, [])
        self.modes.append(scan)
        begin = self._aim(1) + (self.spoil.reset_count() if self.spoil else [])
        parts = zones(self.instance.plant.frames[kind], self.instance.plant.lidar.range)
        for z, zone in enumerate(parts, start=1):
            base = f"{self._name('look', kind)}_{z}"
            looks = [
                Mode(f"{base}_{i}", f"does the ray meet face {i} of zone {z} next?")
                for i in range(1, len(zone.faces) + 1)
            ]
            after = Mode(f"{self._name('next', kind)}_{z}", "the ray is done")
            settle = self._copied(self.dialect.settle(), f"_{after.name}")
            chain = [*looks, settle[0].mode if settle else after]
            where = [
                Constraint(a_s * S + a_f * F, relation, b) for a_s, a_f, relation, b in zone.where
            ]
            self.modes += looks
            self._append(settle, after.name, [])
            self.modes.append(after)
            self.jumps.append(leave(scan, chain[0].name, where, begin))
            sight = self.dialect.sight()
            for look, face, to in zip(looks, zone.faces, chain[1:], strict=True):
                atoms = _meets(self.dialect, sight, face)
                self.jumps += decide(look, atoms, to.name, self.dialect.hit(sight, face.face))
            self._next_ray(after, chain[0].name, seen)
            self.looks = max(self.looks, self.rays * (len(looks) + len(settle) + 1))

    def _next_ray(self, after: Mode, first: str, seen: str) -> None:
        """Add the jumps that keep what the ray at work found and go on with the next one."""
        for ray in range(1, self.rays + 1):
            guard = [Constraint(RAY, ">=", ray - 0.5), Constraint(RAY, "<=", ray + 0.5)]
            keep = self.dialect.keep(ray)
            if ray < self.rays:
                self.jumps.append(leave(after, first, guard, [*keep, *self._aim(ray + 1)]))
            else:
                self.jumps.append(leave(after, seen, guard, keep))

    def _aim(self, ray: int) -> list[Assignment]:
        return [Assignment(RAY.name, constant(float(ray))), *self.dialect.aim(ray)]

    def _work(self) -> list[Step]:
        """Return the steps between scan and drive."""
        steps = [Step(Mode("seen", "every ray has found its face")), *self.dialect.read()]
        inputs = self.dialect.readings()
        if self.spoil:
            steps += spoiled(self.spoil, self.dialect.registers(), inputs)
            inputs = [Variable(name) for name in self.dialect.registers()]
        return [*steps, *self.dialect.network(inputs)]

    def _drive(self, kind: int) -> Mode:
        period = self.instance.plant.period
        name = self._name("drive", kind)
        return Mode(name, "the car drives, steering held", self.dialect.drive(), period)

    def _end_period(self, kind: int, drive: Mode) -> None:
        """Add the jumps at the end of a control period."""
        last = self.instance.steps - 1.5
        more, over = Constraint(COUNT, "<=", last), Constraint(COUNT, ">=", last)
        count = Assignment(COUNT.name, COUNT + 1.0)
        advance = self.instance.plant.frames[kind].advance
        if advance is None or self.classes[advance.to] not in self.kinds:
            self.jumps.append(leave(drive, self._entry(kind), [more], [count]))
        else:
            a_s, a_f, b = advance.guard
            gone = Constraint(a_s * S + a_f * F, ">", b)
            self.jumps += [
                leave(drive, self._entry(kind), [more, gone.negated()], [count]),
                leave(
                    drive,
                    self._entry(self.classes[advance.to]),
                    [more, gone],
                    [*self._change(advance), count],
                ),
            ]
        self.jumps.append(leave(drive, DONE, [over], [count]))

    def _change(self, advance: AdvanceData) -> list[Assignment]:
        (m00, m01), (m10, m11) = advance.matrix
        change = [
            Assignment(S.name, m00 * S + m01 * F + advance.offset[0]),
            Assignment(F.name, m10 * S + m11 * F + advance.offset[1]),
            *self.dialect.turn(advance.rotation),
        ]
        if len(self.kinds) > 1:
            to = float(self.kinds.index(self.classes[advance.to]))
            change.append(Assignment(HALL.name, constant(to)))
        return change

    def _variables(self) -> list[StateVariable]:
        found = [
            StateVariable("s", "distance to the left wall of the hall", "m"),
            StateVariable("f", "distance to the front wall of the hall", "m"),
            StateVariable("v", "speed", "m/s"),
            *self.dialect.variables(),
            StateVariable("ray", "the ray that is looked at, from 1"),
            StateVariable("k", "control periods that are over"),
        ]
        if len(self.kinds) > 1:
            found.append(StateVariable("hall", "kind of hall, from 0"))
        if self.spoil:
            found += disturbance_variables(self.spoil)
        return [*found, StateVariable(CLOCK, "time in the mode", "s")]


def _meets(dialect: Dialect, sight: Sight, face: Face) -> list[Constraint]:
    """Say that a ray meets a face, and nothing nearer so far: see generator.hybrid.sight."""
    gap, approach = sight.gap(face.face), sight.approach(face.face)
    atoms = [] if face.outside else [Constraint(gap, ">", 0.0)]
    for other in face.others:
        cross = sight.gap(other) * approach - sight.approach(other) * gap
        if cross != ZERO:
            atoms.append(Constraint(cross, "<=", 0.0))
    return [*atoms, dialect.nearer(sight, face.face)]
