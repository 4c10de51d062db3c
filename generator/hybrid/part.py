"""What a category adds to the emitted tree in the hybrid formats, for one controller.

The weights of a controller make up nearly all of an automaton's text. So where many instances
differ in start box and property only, what they share is one file of the controller's, and
what is an instance's own goes with it: see docs/hybrid.md.
"""

from __future__ import annotations

import io
import tarfile
from collections.abc import Mapping, Sequence
from enum import Enum

from generator.gzipped import gzipped
from generator.hybrid.export import FORMATS, Exporter
from generator.instances import ControllerFile
from generator.tree import Tree
from racecar.controller import Controller
from racecar.errors import BadInput
from racecar.instance import Instance


class Packing(Enum):
    """How a category's automata are emitted."""

    #: Not at all.
    NONE = "none"
    #: Every instance's files, complete.
    WHOLE = "whole"
    #: What the instances share, and of each instance what is its own.
    PARTS = "parts"
    #: Only the latter, in one archive for each controller; the former lies in another category.
    ARCHIVE = "archive"
    #: What the instances share, and what is their own in one archive for each controller.
    SHARED_ARCHIVE = "shared archive"


def folder_of(form: str) -> str:
    """Return the folder of a format in a category; json is that of the instances themselves."""
    return "automaton" if form == "json" else form


def shared_name(instance: Instance) -> str:
    """Return what the files are called that instances share."""
    return f"{instance.controller.name}.k{instance.steps}"


def hybrid_part(packing: Packing, file: ControllerFile, instances: Sequence[Instance]) -> Tree:
    """Return the files about a controller by path below the category's folder.

    instances: of one category and this controller; unless they are packed WHOLE they differ in
    start box and property only. What a format cannot say is left out.
    """
    tree: Tree = {}
    if packing is Packing.NONE:
        return tree
    exporter = Exporter()
    make = {
        Packing.WHOLE: _whole,
        Packing.PARTS: _parts,
        Packing.ARCHIVE: _archive,
        Packing.SHARED_ARCHIVE: _shared_archive,
    }[packing]
    groups = [[instance] for instance in instances] if packing is Packing.WHOLE else [instances]
    for form in FORMATS:
        for group in groups:
            try:
                files = make(exporter, file.controller, group, form)
            except BadInput:
                continue
            tree |= {f"{folder_of(form)}/{name}": content for name, content in files.items()}
    return tree


def _whole(
    exporter: Exporter, controller: Controller, instances: Sequence[Instance], form: str
) -> Tree:
    return {
        f"{instance.id}{ending}": content
        for instance in instances
        for ending, content in exporter.files(instance, controller, form).items()
    }


def _parts(
    exporter: Exporter, controller: Controller, instances: Sequence[Instance], form: str
) -> Tree:
    tree = _shared(exporter, controller, instances, form)
    for instance in instances:
        own = exporter.own_files(instance, controller, form)
        tree |= {f"{instance.id}{ending}": content for ending, content in own.items()}
    return tree


def _shared_archive(
    exporter: Exporter, controller: Controller, instances: Sequence[Instance], form: str
) -> Tree:
    shared = _shared(exporter, controller, instances, form)
    return shared | _archive(exporter, controller, instances, form)


def _shared(
    exporter: Exporter, controller: Controller, instances: Sequence[Instance], form: str
) -> Tree:
    name = shared_name(instances[0])
    shared = exporter.shared_files(instances[0], controller, form, name)
    return {f"{name}{ending}": content for ending, content in shared.items()}


def _archive(
    exporter: Exporter, controller: Controller, instances: Sequence[Instance], form: str
) -> Tree:
    members = {
        f"{instance.id}{ending}": content
        for instance in instances
        for ending, content in exporter.own_files(instance, controller, form, zipped=False).items()
    }
    return {f"{instances[0].controller.name}.tar.gz": gzipped(tar(members))}


def tar(members: Mapping[str, bytes]) -> bytes:
    """Return a tar file without times and owners: the same members give the same bytes."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.PAX_FORMAT) as file:
        for name, content in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            file.addfile(info, io.BytesIO(content))
    return buffer.getvalue()
