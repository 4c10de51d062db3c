"""The files of instances in each hybrid format."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from generator.hybrid.automaton import Automaton
from generator.hybrid.build import started
from generator.hybrid.document import Document
from generator.hybrid.flowstar import flowstar_model
from generator.hybrid.json_form import automaton_json
from generator.hybrid.native import native_automaton
from generator.hybrid.polynomial import polynomial_automaton
from generator.hybrid.spaceex import spaceex_cfg, spaceex_xml
from generator.hybrid.verisig import network_yaml, verisig_automaton
from generator.hybrid.verisig_files import VerisigFiles, pickled, plain
from racecar.controller import Controller
from racecar.instance import Instance

#: Documents by the ending of the file's name, for an automaton with some start box.
Documents = Callable[[Automaton], dict[str, Document]]


def _flowstar(automaton: Automaton, controller: Controller) -> Documents:
    del automaton, controller
    return lambda automaton: {".model": flowstar_model(automaton)}


def _spaceex(automaton: Automaton, controller: Controller) -> Documents:
    del automaton, controller
    return lambda automaton: {".xml": spaceex_xml(automaton), ".cfg": spaceex_cfg(automaton)}


def _json(automaton: Automaton, controller: Controller) -> Documents:
    del automaton, controller
    return lambda automaton: {".automaton.json": automaton_json(automaton)}


def _verisig(automaton: Automaton, controller: Controller) -> Documents:
    files = VerisigFiles(automaton)

    def document(make: Callable[[], str | bytes]) -> Document:
        def body() -> Iterator[bytes]:
            made = make()
            yield made if isinstance(made, bytes) else made.encode()

        return Document(body=body())

    return lambda automaton: {
        ".network.yml": document(lambda: network_yaml(controller)),
        ".plant.pickle": document(lambda: pickled(files.plant)),
        ".glue.pickle": document(lambda: pickled(files.glue)),
        ".plant.json": document(lambda: _text(files.plant)),
        ".glue.json": document(lambda: _text(files.glue)),
        ".problem.json": Document(_text(files.problem(automaton))),
    }


def _text(data: object) -> str:
    return json.dumps(plain(data), indent=1) + "\n"


#: How each format is made: the automaton, and its documents.
_MAKERS = {
    "flowstar": (polynomial_automaton, _flowstar),
    "spaceex": (polynomial_automaton, _spaceex),
    "json": (native_automaton, _json),
    "verisig": (verisig_automaton, _verisig),
}
FORMATS = tuple(_MAKERS)


@dataclass
class _Kept:
    """What instances that differ in ID and start box share; bodies: by ending and packing."""

    key: str
    automaton: Automaton
    documents: Documents
    bodies: dict[tuple[str, bool], bytes] = field(default_factory=dict)


class Exporter:
    """Makes the files of instances, one after the other.

    What the last instance of a format shares with the next, all but the start box, is kept.
    """

    def __init__(self) -> None:
        self._kept: dict[str, _Kept] = {}

    def files(
        self, instance: Instance, controller: Controller, form: str, zipped: bool = True
    ) -> dict[str, bytes]:
        """Return the files of an instance in one of FORMATS, by the ending of their names.

        zipped: compress each file and end its name in ``.gz``. The same instance gives the same
        bytes. Raises BadInput where the format cannot say the instance.
        """
        key = instance.model_dump_json(exclude={"id", "category", "initial_set"})
        kept = self._kept.get(form)
        if kept is None or kept.key != key:
            automaton, documents = _MAKERS[form]
            made = automaton(instance, controller)
            kept = self._kept[form] = _Kept(key, made, documents(made, controller))
        files = {}
        for ending, document in kept.documents(started(kept.automaton, instance)).items():
            if (ending, zipped) not in kept.bodies:
                kept.bodies[ending, zipped] = document.made_body(zipped)
            content = document.content(kept.bodies[ending, zipped], zipped)
            files[f"{ending}.gz" if zipped else ending] = content
        return files


def hybrid_files(
    instance: Instance, controller: Controller, form: str, zipped: bool = True
) -> dict[str, bytes]:
    """Return the files of one instance, see Exporter.files."""
    return Exporter().files(instance, controller, form, zipped)
