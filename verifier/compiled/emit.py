"""A traced program as LLVM assembly: a loop over the batch, a few places at a time.

Vectors of doubles, one instruction per traced operation, none of the flags that would allow LLVM
to reassociate or contract. The last places, fewer than a vector, are read one by one, the last
of all repeated, and written likewise: repeated places compute, and write, the same.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

from verifier.compiled.trace import Trace, Value

_COMPARE = {"olt", "ole", "ogt", "oge", "uno"}
_TRUTH = _COMPARE | {"and", "or", "not"}


def assembly(trace: Trace, outputs: Sequence[Value], lanes: int) -> str:
    """Return LLVM assembly of one function, ``kernel``.

    Its parameters, all 64 bits: the number of places; the output's address and the distance of
    its rows (in doubles); the same two of each table; the address of each index array.
    """
    return _Writer(trace, outputs, lanes).function()


class _Writer:
    def __init__(self, trace: Trace, outputs: Sequence[Value], lanes: int) -> None:
        self._trace = trace
        self._outputs = outputs
        self._lanes = lanes
        self._vector = f"<{lanes} x double>"
        self._lines: list[str] = []
        self._fresh = 0

    def function(self) -> str:
        trace, lanes = self._trace, self._lanes
        parameters = ["i64 %n", "ptr %out", "i64 %outstride"]
        for t in range(len(trace.tables)):
            parameters += [f"ptr %t{t}", f"i64 %s{t}"]
        parameters += [f"ptr %x{i}" for i in range(trace.indices)]
        put = self._lines.append
        put(f"define void @kernel({', '.join(parameters)}) nounwind {{")
        put("entry:")
        put("  %last = sub i64 %n, 1")
        used = sorted({op[1:] for op in trace.operations if op[0] == "load"})
        for t, k in used:
            put(f"  %o{t}_{k} = mul i64 %s{t}, {k}")
            put(f"  %p{t}_{k} = getelementptr double, ptr %t{t}, i64 %o{t}_{k}")
        for k in range(len(self._outputs)):
            put(f"  %oo{k} = mul i64 %outstride, {k}")
            put(f"  %po{k} = getelementptr double, ptr %out, i64 %oo{k}")
        put("  br label %loop")
        put("loop:")
        put("  %i = phi i64 [ 0, %entry ], [ %next, %stored ]")
        put(f"  %next = add i64 %i, {lanes}")
        put("  %whole = icmp sle i64 %next, %n")
        put("  br i1 %whole, label %full, label %tail")
        put("full:")
        places = self._places("f", clamp=False)
        full = self._loads(used, places, "f", direct=True)
        put("  br label %body")
        put("tail:")
        tails = self._places("t", clamp=True)
        tail = self._loads(used, tails, "t", direct=False)
        put("  br label %body")
        put("body:")
        for t, k in used:
            put(
                f"  %l{t}_{k} = phi {self._vector} [ {full[t, k]}, %full ], [ {tail[t, k]}, %tail ]"
            )
        self._body()
        put("  br i1 %whole, label %storefull, label %storetail")
        put("storefull:")
        for k, value in enumerate(self._outputs):
            put(f"  %q{k} = getelementptr double, ptr %po{k}, i64 %i")
            put(f"  store {self._vector} {self._name(value.place)}, ptr %q{k}, align 8")
        put("  br label %stored")
        put("storetail:")
        # The places again: values of the block "tail" do not reach here from "full".
        again = self._places("s", clamp=True)
        for k, value in enumerate(self._outputs):
            for lane, place in enumerate(again):
                element, at = self._temporary(), self._temporary()
                vector = self._name(value.place)
                put(f"  {element} = extractelement {self._vector} {vector}, i64 {lane}")
                put(f"  {at} = getelementptr double, ptr %po{k}, i64 {place}")
                put(f"  store double {element}, ptr {at}, align 8")
        put("  br label %stored")
        put("stored:")
        put("  %more = icmp slt i64 %next, %n")
        put("  br i1 %more, label %loop, label %done")
        put("done:")
        put("  ret void")
        put("}")
        return "\n".join(self._lines) + "\n"

    def _temporary(self) -> str:
        self._fresh += 1
        return f"%v{self._fresh}"

    def _places(self, block: str, clamp: bool) -> list[str]:
        """Return the batch's places of all lanes, never beyond the last where clamped."""
        names = []
        for lane in range(self._lanes):
            name = f"%{block}place{lane}"
            self._lines.append(f"  {name} = add i64 %i, {lane}")
            if clamp:
                self._lines.append(f"  {name}over = icmp sgt i64 {name}, %last")
                self._lines.append(f"  {name}in = select i1 {name}over, i64 %last, i64 {name}")
                name = f"{name}in"
            names.append(name)
        return names

    def _loads(
        self, used: list[tuple], places: list[str], block: str, direct: bool
    ) -> dict[tuple, str]:
        put, found = self._lines.append, {}
        read: dict[int | None, list[str]] = {None: places}
        for x in range(self._trace.indices):
            read[x] = []
            for lane, place in enumerate(places):
                put(f"  %{block}a{x}_{lane} = getelementptr i64, ptr %x{x}, i64 {place}")
                put(f"  %{block}i{x}_{lane} = load i64, ptr %{block}a{x}_{lane}, align 8")
                read[x].append(f"%{block}i{x}_{lane}")
        for t, k in used:
            index = self._trace.tables[t].index
            if direct and index is None:
                at, whole = self._temporary(), self._temporary()
                put(f"  {at} = getelementptr double, ptr %p{t}_{k}, i64 %i")
                put(f"  {whole} = load {self._vector}, ptr {at}, align 8")
                found[t, k] = whole
                continue
            vector = "poison"
            for lane, place in enumerate(read[index]):
                at, element, after = (self._temporary() for _ in range(3))
                put(f"  {at} = getelementptr double, ptr %p{t}_{k}, i64 {place}")
                put(f"  {element} = load double, ptr {at}, align 8")
                put(
                    f"  {after} = insertelement {self._vector} {vector}, "
                    f"double {element}, i64 {lane}"
                )
                vector = after
            found[t, k] = vector
        return found

    def _name(self, place: int) -> str:
        name, *operands = self._trace.operations[place]
        if name == "load":
            return f"%l{operands[0]}_{operands[1]}"
        if name == "constant":
            bits = struct.pack(">d", float.fromhex(operands[0])).hex().upper()
            return "<" + ", ".join([f"double 0x{bits}"] * self._lanes) + ">"
        return f"%r{place}"

    def _body(self) -> None:
        lanes, vector = self._lanes, self._vector
        truth, whole = f"<{lanes} x i1>", f"<{lanes} x i64>"
        put = self._lines.append
        names = [self._name(place) for place in range(len(self._trace.operations))]
        for place, (name, *operands) in enumerate(self._trace.operations):
            if name in {"load", "constant"}:
                continue
            args = [names[i] for i in operands]
            result = f"  %r{place} = "
            if name in _COMPARE:
                put(f"{result}fcmp {name} {vector} {args[0]}, {args[1]}")
            elif name in {"and", "or"}:
                put(f"{result}{name} {truth} {args[0]}, {args[1]}")
            elif name == "not":
                put(f"{result}xor {truth} {args[0]}, splat (i1 true)")
            elif name == "select":
                put(f"{result}select {truth} {args[0]}, {vector} {args[1]}, {vector} {args[2]}")
            elif name in {"max", "min"}:
                test = "ogt" if name == "max" else "olt"
                put(f"  %c{place} = fcmp {test} {vector} {args[0]}, {args[1]}")
                put(f"{result}select {truth} %c{place}, {vector} {args[0]}, {vector} {args[1]}")
            elif name in {"fabs", "sqrt"}:
                put(f"{result}call {vector} @llvm.{name}.v{lanes}f64({vector} {args[0]})")
            elif name == "exponent":
                put(f"  %b{place} = bitcast {vector} {args[0]} to {whole}")
                put(f"  %h{place} = shl {whole} %b{place}, splat (i64 52)")
                put(f"{result}bitcast {whole} %h{place} to {vector}")
            elif name == "fneg":
                put(f"{result}fneg {vector} {args[0]}")
            else:
                put(f"{result}{name} {vector} {args[0]}, {args[1]}")
