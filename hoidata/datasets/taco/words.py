"""TACO's words: each recording lies in a folder named ``(action, tool, object)``."""

import re

from hoidata.errors import BadInput

TRIPLET = re.compile(r"\(([^,()]+),([^,()]+),([^,()]+)\)")


def triplet(name: str) -> tuple[str, str, str]:
    """Action, tool and object in words of ``(put in, spoon, bowl)/20230927_034``. Raises BadInput for another form."""
    folder = name.partition("/")[0]
    found = TRIPLET.fullmatch(folder)
    if found is None:
        raise BadInput(f"Hand_Poses/{folder}", "a folder named (action, tool, object)", folder, "restore its name")
    action, tool, thing = (" ".join(word.replace("_", " ").split()) for word in found.groups())
    return action.lower(), tool, thing
