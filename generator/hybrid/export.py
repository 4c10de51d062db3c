"""The files of instances in each hybrid format."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

from generator.hybrid.automaton import Automaton
from generator.hybrid.build import asked, kinds_of_hall
from generator.hybrid.document import Document, Documents, own, shared
from generator.hybrid.flowstar import flowstar_model
from generator.hybrid.json_form import automaton_json, question_json
from generator.hybrid.native import native_automaton
from generator.hybrid.polynomial import polynomial_automaton
from generator.hybrid.spaceex import spaceex_cfg, spaceex_xml
from generator.hybrid.verisig import network_yaml, verisig_automaton
from generator.hybrid.verisig_files import VerisigFiles, pickled, plain
from racecar.controller import Controller
from racecar.instance import Instance

#: Builds an automaton.
Make = Callable[[Instance, Controller], Automaton]
#: The documents of an automaton with some start box and property.
Print = Callable[[Automaton], Documents]


def _flowstar(automaton: Automaton, controller: Controller) -> Print:
    del automaton, controller
    return lambda automaton: {".model": flowstar_model(automaton)}


def _spaceex(automaton: Automaton, controller: Controller) -> Print:
    del automaton, controller
    return lambda automaton: {".xml": spaceex_xml(automaton), ".cfg": spaceex_cfg(automaton)}


def _json(automaton: Automaton, controller: Controller) -> Print:
    del automaton, controller
    return lambda automaton: {".automaton.json": automaton_json(automaton)}


def _verisig(automaton: Automaton, controller: Controller) -> Print:
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
_MAKERS: dict[str, tuple[Make, Callable[[Automaton, Controller], Print]]] = {
    "flowstar": (polynomial_automaton, _flowstar),
    "spaceex": (polynomial_automaton, _spaceex),
    "json": (native_automaton, _json),
    "verisig": (verisig_automaton, _verisig),
}
FORMATS = tuple(_MAKERS)


@dataclass
class _Kept:
    """What instances share that differ in ID, start box and property.

    bodies: by ending and packing.
    """

    key: str
    automaton: Automaton
    documents: Print
    bodies: dict[tuple[str, bool], bytes] = field(default_factory=dict)


class Exporter:
    """Makes the files of instances, one after the other.

    What the last instance of a format shares with the next, all but the start box and the
    property, is kept. Files are given by the ending of their names; ``zipped`` compresses each of
    them and adds ``.gz`` to its name. The same instance gives the same bytes.
    """

    def __init__(self) -> None:
        self._kept: dict[str, _Kept] = {}
        self._made: dict[Make, tuple[str, Automaton]] = {}

    def prepare(self, instance: Instance, controller: Controller, form: str) -> None:
        """Raise BadInput if a format cannot say an instance."""
        self._keep(instance, controller, form)

    def files(
        self, instance: Instance, controller: Controller, form: str, zipped: bool = True
    ) -> dict[str, bytes]:
        """Return the files of an instance in one of FORMATS.

        Raises BadInput where the format cannot say the instance.
        """
        kept, automaton = self._keep(instance, controller, form)
        return _contents(kept, kept.documents(automaton), zipped)

    def shared_files(
        self, instance: Instance, controller: Controller, form: str, name: str, zipped: bool = True
    ) -> dict[str, bytes]:
        """Return what an instance shares with all that differ in start box and property only.

        With the own files of an instance it is complete. name: what the text calls itself.
        """
        kept, automaton = self._keep(instance, controller, form)
        return _contents(kept, shared(kept.documents(replace(automaton, name=name))), zipped)

    def own_files(
        self, instance: Instance, controller: Controller, form: str, zipped: bool = True
    ) -> dict[str, bytes]:
        """Return what makes the shared files those of an instance."""
        kept, automaton = self._keep(instance, controller, form)
        documents = own(kept.documents(automaton))
        if form == "json":
            documents[".question.json"] = question_json(automaton)
        return _contents(kept, documents, zipped)

    def _keep(
        self, instance: Instance, controller: Controller, form: str
    ) -> tuple[_Kept, Automaton]:
        """Return what is kept, and the automaton of the instance."""
        kinds = kinds_of_hall(instance)
        key = instance.model_dump_json(exclude={"id", "category", "initial_set", "property"})
        key += repr(kinds)
        kept = self._kept.get(form)
        if kept is None or kept.key != key:
            make, documents = _MAKERS[form]
            made = self._automaton(make, key, instance, controller)
            kept = self._kept[form] = _Kept(key, made, documents(made, controller))
        return kept, asked(kept.automaton, instance, kinds)

    def _automaton(
        self, make: Make, key: str, instance: Instance, controller: Controller
    ) -> Automaton:
        """Return the automaton of an instance, made once for all formats that print it."""
        known, automaton = self._made.get(make, ("", None))
        if automaton is None or known != key:
            automaton = make(instance, controller)
            self._made[make] = key, automaton
        return automaton


def _contents(kept: _Kept, documents: Documents, zipped: bool) -> dict[str, bytes]:
    files = {}
    for ending, document in documents.items():
        body = b""
        if document.body is not None:
            place = ending.removesuffix(".head"), zipped
            if place not in kept.bodies:
                kept.bodies[place] = document.made_body(zipped)
            body = kept.bodies[place]
        files[f"{ending}.gz" if zipped else ending] = document.content(body, zipped)
    return files


def hybrid_files(
    instance: Instance, controller: Controller, form: str, zipped: bool = True
) -> dict[str, bytes]:
    """Return the files of one instance, see Exporter.files."""
    return Exporter().files(instance, controller, form, zipped)
