"""S-expressions with the lines they stand in."""

from __future__ import annotations

import re

from racecar.errors import BadInput

#: Deeper nesting is refused: later steps go down into it.
DEEPEST = 100

#: An index in brackets belongs to the name before it: ``X[0, 3]`` is one symbol.
_TOKEN = re.compile(r'[()\n]|;[^\n]*|"[^"\n]*"|[^\s()\[\];"]+(?:[ \t]*\[[^\[\]()\n;"]*\])?|[^\s]')


class Form(list["str | Form"]):
    """A parenthesised list; line: of the file, where it begins."""

    __slots__ = ("line",)

    def __init__(self, line: int) -> None:
        super().__init__()
        self.line = line


def parse_forms(text: str, where: str) -> list[Form]:
    """Return the forms of a text, comments (``;`` to the end of the line) left out.

    where: how errors call the text. BadInput says in which line something is wrong.
    """
    line = 1
    top = Form(1)
    open_forms = [top]
    for token in _TOKEN.findall(text):
        if token == "(":
            if len(open_forms) > DEEPEST:
                raise BadInput(f"{where}, line {line}: nested deeper than {DEEPEST} levels")
            form = Form(line)
            open_forms[-1].append(form)
            open_forms.append(form)
        elif token == ")":
            if len(open_forms) == 1:
                raise BadInput(f"{where}, line {line}: a closing parenthesis too many")
            open_forms.pop()
        elif token == "\n":
            line += 1
        elif token[0] != ";":
            if token in '[]"':
                raise BadInput(f"{where}, line {line}: {token} stands alone")
            if len(open_forms) == 1:
                raise BadInput(f"{where}, line {line}: {token[:40]!r} stands outside parentheses")
            open_forms[-1].append(token)
    if len(open_forms) > 1:
        raise BadInput(f"{where}, line {open_forms[-1].line}: this parenthesis is never closed")
    return [form for form in top if isinstance(form, Form)]
