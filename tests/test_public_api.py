"""The public names of the package and their signatures, compared with tests/public_api.txt.

    python tests/test_public_api.py

writes that file anew: do so with a change that is meant, and announce it (CONTRIBUTING.md).
"""

import dataclasses
import difflib
import enum
import importlib
import inspect
from pathlib import Path

import gftorf_warp

SNAPSHOT = Path(__file__).parent / "public_api.txt"
MODULES = (  # besides the names of gftorf_warp itself; docs/library.md lists them, too
    "data.check",
    "data.decode",
    "data.write",
    "errors",
    "recon.presets",
    "recon.settings",
    "scene.gaussians",
    "scene.sensor",
)
PLAIN = (int, float, str, bool, type(None), enum.Enum)  # what a default may be to be shown


def shown(default):
    """Return the text of a default value; that of an object would differ from run to run."""
    if isinstance(default, enum.Enum):
        return f"{type(default).__name__}.{default.name}"
    simple = default if isinstance(default, tuple) else (default,)
    return repr(default) if all(isinstance(part, PLAIN) for part in simple) else "..."


def annotated(name, annotation, default):
    """Return a parameter or field as it is declared."""
    kind = annotation if isinstance(annotation, str) else getattr(annotation, "__name__", "...")
    text = name if annotation is inspect.Parameter.empty else f"{name}: {kind}"
    return text if default is inspect.Parameter.empty else f"{text} = {shown(default)}"


def signature_of(function):
    """Return parameters and result of a function, one line."""
    parts, keyword_only = [], False
    signature = inspect.signature(function)
    for parameter in signature.parameters.values():
        mark = {parameter.VAR_POSITIONAL: "*", parameter.VAR_KEYWORD: "**"}.get(parameter.kind, "")
        if parameter.kind is parameter.KEYWORD_ONLY and not keyword_only:
            parts.append("*")
        keyword_only |= parameter.kind in (parameter.KEYWORD_ONLY, parameter.VAR_POSITIONAL)
        parts.append(mark + annotated(parameter.name, parameter.annotation, parameter.default))
    result = signature.return_annotation
    empty = result is inspect.Signature.empty
    return f"({', '.join(parts)})" + ("" if empty else f" -> {result}")


def lines_of_class(name, kind):
    """Yield a class, then its fields or members, then its public methods and properties."""
    bases = ", ".join(base.__name__ for base in kind.__bases__ if base is not object)
    yield f"{name}({bases})" if bases else name
    if issubclass(kind, enum.Enum):
        yield from (f"{name}.{member.name} = {member.value!r}" for member in kind)
        return
    if dataclasses.is_dataclass(kind):
        for field in dataclasses.fields(kind):
            missing = field.default is dataclasses.MISSING
            default = ... if missing and field.default_factory is not dataclasses.MISSING else None
            default = field.default if not missing else default or inspect.Parameter.empty
            yield f"{name}.{annotated(field.name, field.type, default)}"
    written = not dataclasses.is_dataclass(kind)  # those of dataclasses repeat their fields
    members = {}
    for one in kind.__mro__[::-1] if dataclasses.is_dataclass(kind) else [kind]:  # inherited, too
        members |= vars(one) if one.__module__.startswith("gftorf_warp.") else {}
    for member, value in members.items():
        if member.startswith("_") and not (member == "__init__" and written):
            continue
        if isinstance(value, classmethod | staticmethod):
            yield f"{name}.{member}{signature_of(value.__func__)}"
        elif inspect.isfunction(value):
            yield f"{name}.{member}{signature_of(value)}"
        elif isinstance(value, property) or type(value).__name__ == "cached_property":
            yield f"{name}.{member}"


def lines_of(name, value):
    """Yield what is public of one name."""
    if inspect.isclass(value):
        yield from lines_of_class(name, value)
    elif inspect.isfunction(value):
        yield name + signature_of(value)
    else:
        yield name


def public_lines():
    """Return all lines of the snapshot."""
    found = []
    for name in sorted(gftorf_warp.__all__):
        found += lines_of(f"gftorf_warp.{name}", getattr(gftorf_warp, name))
    known = {id(getattr(gftorf_warp, name)) for name in gftorf_warp.__all__}
    for place in MODULES:
        module = importlib.import_module(f"gftorf_warp.{place}")
        for name, value in sorted(vars(module).items()):
            home = getattr(value, "__module__", None)  # constants have none
            own = home == module.__name__ or (home and name in getattr(module, "__all__", ()))
            if own and not name.startswith("_") and id(value) not in known:
                found += lines_of(f"gftorf_warp.{place}.{name}", value)
    return found


def test_the_public_names_are_those_of_the_snapshot():
    """A change of a name or signature is seen by whoever makes it, and announced."""
    before, now = SNAPSHOT.read_text(encoding="utf-8").splitlines(), public_lines()
    changes = [
        line
        for line in difflib.unified_diff(before, now, lineterm="", n=0)
        if line[:1] in "+-" and line[:3] not in ("+++", "---")
    ]
    assert not changes, (
        "the public API changed: if that is meant, run `python tests/test_public_api.py`, and "
        "announce it in CHANGELOG.md (CONTRIBUTING.md, Public names):\n" + "\n".join(changes)
    )


if __name__ == "__main__":
    SNAPSHOT.write_text("\n".join(public_lines()) + "\n", encoding="utf-8")
