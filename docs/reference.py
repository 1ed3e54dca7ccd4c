"""The reference pages of the site, written from the code: commands, settings, errors, Python."""

import ast
import dataclasses
import enum
import inspect
import math
import re
from collections.abc import Iterator
from pathlib import Path

from sphinx.pycode import ModuleAnalyzer
from test_public_api import MODULES

import gftorf_warp
from gftorf_warp import errors, options
from gftorf_warp.recon.settings import ReconSettings
from gftorf_warp.recon.volume.settings import VolumeSettings
from gftorf_warp.scene.sensor import Sensor
from gftorf_warp.sim.settings import SimSettings

PACKAGE = Path(gftorf_warp.__file__).parent


def write(folder: Path) -> None:
    """Write all reference pages into ``folder``."""
    pages = {
        "commands.md": commands(),
        "settings.md": settings(),
        "errors.md": refusals(),
        "python.rst": python(),
    }
    for name, text in pages.items():
        (folder / name).write_text(text, encoding="utf-8")


def table(*heads: str, rows: list[tuple[str, ...]]) -> str:
    """A Markdown table whose cells lie below each other on a phone, see site.css."""
    lines = [heads, ("---",) * len(heads), *rows]
    cells = ([" ".join(cell.split()).replace("|", "\\|") for cell in line] for line in lines)
    text = "\n".join(f"| {' | '.join(line)} |" for line in cells)
    return f"```{{rst-class}} stacked\n```\n\n{text}\n"


def commands() -> str:
    """Every command with its arguments and options."""
    parsers = options.command_parsers()
    rows = {name: option_rows(parser) for name, parser in parsers.items()}
    common = [row for row in next(iter(rows.values())) if all(row in own for own in rows.values())]
    text = "# Commands\n\n`gftorf COMMAND --help` prints the same. Defaults are in parentheses.\n\n"
    text += f"{exit_codes()}\nOptions of every command:\n\n"
    text += table("option", "meaning", rows=common)
    for name, parser in parsers.items():
        own = [row for row in rows[name] if row not in common]
        text += f"\n## gftorf {name}\n\n{sentence(parser.description)}\n\n"
        text += table("option", "meaning", rows=own)
    return text


def option_rows(parser: options.Parser) -> list[tuple[str, str]]:
    """Arguments and options of a command: how they are typed, what they mean."""
    return [
        (f"`{' '.join([', '.join(action.option_strings), action.metavar or '']).strip()}`", text)
        for action in parser._actions  # argparse has no public list of them
        for text in [(action.help or "").replace("%%", "%")]
    ]


def exit_codes() -> str:
    """What a command returns to the shell."""
    rows = [("0", "success"), ("1", "a bug, or a failed self-test")]
    rows += [(str(kind.exit_code), first_line(kind)) for kind in error_kinds()]
    rows += [("130, 143", "interrupted by Ctrl-C, by SIGTERM")]
    return table("exit code", "means", rows=rows)


def error_kinds() -> list[type[errors.GftorfError]]:
    """The classes of errors.py that end a command, by exit code."""
    kinds = errors.GftorfError.__subclasses__()
    return sorted((k for k in kinds if k.__module__ == errors.__name__), key=lambda k: k.exit_code)


def settings() -> str:
    """Every setting with its default, unit and meaning, as docstrings below the fields say."""
    pages = (
        (
            "Reconstruction",
            "",
            ReconSettings,
            "As `gftorf reconstruct --set NAME=VALUE` takes them; config.json of a run lists them. "
            "Presets change many of the defaults: [Presets](../presets.md).",
        ),
        (
            "Neural volumes",
            "volume.",
            VolumeSettings,
            "The same for presets `torf` and `ftorf`, which have no Gaussians.",
        ),
        (
            "Simulation",
            "",
            SimSettings,
            "Arguments of `gftorf_warp.simulate`, options of `gftorf simulate`.",
        ),
        (
            "Sensor",
            "sensor.",
            Sensor,
            "As `gftorf simulate --override sensor.NAME=VALUE` takes them, or scene files.",
        ),
    )
    text = "# Settings\n\nMade from the code.\n"
    for title, start, kind, introduction in pages:
        text += f"\n## {title}\n\n{introduction}\n"
        for prefix, part in parts_of(kind, start):
            text += f"\n### {prefix.rstrip('.')}\n\n" if prefix != start else "\n"
            text += f"{markdown(first_line(part))}\n\n"
            rows = list(setting_rows(part, prefix))
            text += table("setting", "default", "unit", "meaning", rows=rows)
    return text


def parts_of(kind: type, prefix: str = "") -> Iterator[tuple[str, type]]:
    """A settings class and those that its fields hold, with the prefix of their names."""
    yield prefix, kind
    for field in dataclasses.fields(kind):
        part = type(default_of(field))
        if dataclasses.is_dataclass(part):
            yield from parts_of(part, f"{prefix}{field.name}.")


def setting_rows(kind: type, prefix: str) -> Iterator[tuple[str, str, str, str]]:
    """Name, default, unit and meaning of the fields of a class that are no classes themselves."""
    meanings = ModuleAnalyzer.for_module(kind.__module__).find_attr_docs()
    for field in dataclasses.fields(kind):
        default = default_of(field)
        if dataclasses.is_dataclass(default):
            continue
        meaning = " ".join(meanings.get((kind.__name__, field.name), []))
        if isinstance(default, enum.Enum):
            meaning += f" One of {', '.join(f'`{member.value}`' for member in type(default))}."
        unit = re.search(r" ?\[([^\],]+)\]", meaning)
        if unit:
            meaning = meaning.replace(unit[0], "", 1)
        yield (
            f"`{prefix}{field.name}`",
            shown(default),
            unit[1] if unit else "",
            markdown(meaning),
        )


def default_of(field: dataclasses.Field) -> object:
    """The default of a field of a dataclass; MISSING if it has none."""
    made = field.default_factory
    return field.default if made is dataclasses.MISSING else made()


def shown(value: object) -> str:
    """A default as it would be typed."""
    if value is dataclasses.MISSING:
        return "*needed*"
    if value is None:
        return "none"
    if isinstance(value, enum.Enum):
        return f"`{value.value}`"
    if isinstance(value, tuple):
        return f"`{','.join(shown(part).strip('`') for part in value)}`" if value else "none"
    if isinstance(value, float) and math.isfinite(value):
        return f"`{value:.6g}`"
    return f"`{value}`"


def refusals() -> str:
    """What the program refuses, why, and what to do: every error that the package raises."""
    text = (
        "# Errors, and what to do\n\nEvery refusal says what is wrong, where, why, and what to do "
        "about it; a traceback is a bug. This page is made from the code. `…` stands for names "
        "and numbers of the case at hand.\n\n" + exit_codes()
    )
    found = sorted(set(raised_errors()))
    for area in sorted({row[0] for row in found}):
        rows = [(what, why, fix) for place, what, why, fix in found if place == area]
        text += f"\n## {area}\n\n" + table("what", "why", "what to do", rows=rows)
    return text


def raised_errors() -> Iterator[tuple[str, str, str, str]]:
    """Area, what, why and fix of every error whose name is written where it is raised."""
    kinds = {kind.__name__ for kind in error_kinds()}
    for path in sorted(PACKAGE.rglob("*.py")):
        place = path.relative_to(PACKAGE).parts
        area = place[0] if len(place) > 1 else "command line"
        source = path.read_text(encoding="utf-8")
        if not any(f"{kind}(" in source for kind in kinds):
            continue
        for function in ast.walk(ast.parse(source)):
            if not isinstance(function, ast.FunctionDef):
                continue
            calls = [node for node in ast.walk(function) if isinstance(node, ast.Call)]
            calls = [call for call in calls if getattr(call.func, "id", "") in kinds]
            assignments = list(assigned(function)) if calls else []
            for call in calls:
                row = error_row(call, assignments)
                if all(text.strip("…: ") for text in (row[0], row[1] + row[2])):
                    yield area, *row


def error_row(call: ast.Call, assignments: list[tuple[str, ast.expr]]) -> tuple[str, str, str]:
    """What, why and fix of the call of an error class, where names are as last assigned."""
    texts = {}
    for name, value in assignments:
        if value.lineno < call.lineno:
            texts[name] = text_of(value, texts)
    given = {word.arg: word.value for word in call.keywords}
    parts = (call.args[0] if call.args else None, given.get("why"), given.get("fix"))
    what, why, fix = (markdown(text_of(part, texts)) for part in parts)
    return what, why, fix


def assigned(function: ast.FunctionDef) -> Iterator[tuple[str, ast.expr]]:
    """Names and values of the assignments of a function, those of tuples too."""
    for node in ast.walk(function):
        if isinstance(node, ast.AugAssign) and isinstance(node.target, ast.Name):
            sum_ = ast.BinOp(node.target, node.op, node.value)
            yield node.target.id, ast.copy_location(sum_, node)
        if isinstance(node, ast.Assign):
            target, value = node.targets[0], node.value
            both = isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple)
            pairs = zip(target.elts, value.elts, strict=False) if both else [(target, value)]
            yield from ((name.id, part) for name, part in pairs if isinstance(name, ast.Name))


def text_of(node: ast.expr | None, texts: dict[str, str]) -> str:
    """A text in the source, with … for what is computed."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(text_of(part, texts) for part in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return text_of(node.left, texts) + text_of(node.right, texts)
    if isinstance(node, ast.FormattedValue):
        return text_of(node.value, texts)
    if isinstance(node, ast.Name):
        return texts.get(node.id, "…")
    return "…"


def python() -> str:
    """The public names with signatures and docstrings, as Sphinx directives."""
    names = [name for name in gftorf_warp.__all__ if name != "__version__"]
    objects = {name: getattr(gftorf_warp, name) for name in names}
    text = (
        "Python\n======\n\nThe public names: those of the package, then those of modules. Arrays "
    )
    text += "have their shape in brackets or in the annotation, numbers their unit.\n\n"
    text += ".. module:: gftorf_warp\n\n"
    for name, thing in objects.items():
        kind = "autoclass" if inspect.isclass(thing) else "autofunction"
        text += f"{name}\n{'-' * len(name)}\n\n.. {kind}:: gftorf_warp.{name}\n"
        text += "   :members:\n   :inherited-members:\n\n" if kind == "autoclass" else "\n"
    for name in MODULES:
        module = f"gftorf_warp.{name}"
        shown_above = ", ".join(n for n, o in objects.items() if o.__module__ == module)
        text += f"{module}\n{'-' * len(module)}\n\n.. automodule:: {module}\n   :members:\n"
        text += f"   :exclude-members: {shown_above}\n\n" if shown_above else "\n"
    return text


def first_line(thing: object) -> str:
    """The first paragraph of a docstring."""
    return " ".join((inspect.getdoc(thing) or "").partition("\n\n")[0].split())


def sentence(text: str | None) -> str:
    """With a capital letter and a full stop."""
    return f"{text[0].upper()}{text[1:]}." if text else ""


def markdown(text: str) -> str:
    """Markup of docstrings as Markdown; nothing else in it has a meaning there."""
    text = re.sub(r":\w+:`~?\.?([^`]+)`", r"`\1`", text).replace("``", "`")
    return re.sub(r"(?<!\\)([<>*_\[\]])(?=[^`]*(?:`[^`]*`[^`]*)*$)", r"\\\1", text)
