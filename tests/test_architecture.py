"""The import table of ARCHITECTURE.md and the reading rules of CONTRIBUTING.md,
enforced on the source text.
"""

import ast
import functools
import importlib
import inspect
import re
import sys
from pathlib import Path

import pytest

from gftorf_warp.render import api, reference

REPOSITORY = Path(__file__).parents[1]
ROOT = REPOSITORY / "gftorf_warp"
FILES = sorted(ROOT.rglob("*.py"))
MAX_LINES = 500  # of at most 100 columns
MAX_COLUMNS = 100
LONG = {  # file: why it may be longer
    "kernels/network/wgmma.py": "two passes over one ring of weights, each of them twice: for "
    "CUDA and for the CPU",
}
TORCH = {"jaxtyping", "numpy", "torch"}
INSIDE_FUNCTIONS = {
    "OpenEXR",
    "cv2",
    "h5py",
    "matplotlib",
    "rawpy",
    "scipy",
    "trimesh",
    "viser",
}  # slow to import, or not needed by every command
# room: (rooms it may import besides itself, packages it may import); those of FREE are free to all
TABLE = {
    "constants.py": (set(), set()),
    "errors.py": (set(), set()),
    "similar.py": (set(), set()),
    "kernels": (set(), {"warp"}),
    "data": (set(), {"OpenEXR", "cv2", "jaxtyping", "numpy"}),
    "importers": ({"data"}, {"cv2", "h5py", "jaxtyping", "numpy", "rawpy"}),
    "scene": ({"data"}, TORCH | {"cv2"}),
    "render": ({"kernels", "scene"}, TORCH | {"warp"}),
    "losses": ({"render"}, TORCH),
    "sim": ({"data", "kernels", "render", "scene"}, TORCH | {"trimesh"}),
    "recon": ({"data", "losses", "render", "scene"}, TORCH | {"cv2"}),
    "evaluate": ({"data", "losses", "recon", "render", "scene"}, TORCH | {"cv2"}),
    "export": ({"data", "evaluate", "recon", "render", "scene"}, TORCH | {"cv2", "trimesh"}),
    "view": (
        {"data", "evaluate", "export", "recon", "render", "scene"},
        TORCH | {"viser"},
    ),
    "sweep": (
        {"data", "evaluate", "process", "recon", "render", "scene", "sim", "terminal"},
        TORCH | {"cv2", "distributed"},
    ),
    "bench": ({"data", "evaluate", "recon", "render", "scene", "sim"}, TORCH | {"warp"}),
}
FREE = {"constants", "errors", "similar", "__version__"}
HAS_BOTH = {  # the only modules that may know torch and Warp together
    "render/bridge.py": "a rendering, and its gradient",
    "render/cuda.py": "streams and graphs that both use",
    "render/fused.py": "what a step does beside rendering: other kernels and callers",
    "render/displacement.py": "motion of torch, one kernel of Warp",
    "render/hash_grid.py": "features of a volume: tensors of torch, one kernel of Warp",
    "render/descent.py": "the end of a step: Adam and what judges it, of many tensors at once",
    "render/moved.py": "Gaussians of a finished run at a time",
    "render/replay.py": "renderings of a finished run: a field of torch, a graph of Warp",
    "render/tensor_cores.py": "layers of a network: tensors of torch, kernels of Warp",
}
LAUNCHES = {  # file: what it launches
    "render/runtime.py": "whatever the files below do, the first of a kernel alone",
    "render/launch.py": "the order of a rendering",
    "render/stages.py": "the stages of a rendering",
    "render/side_by_side.py": "its launches over ranges of tiles",
    "render/fused.py": "losses, backgrounds and Adam",
    "render/displacement.py": "Gaussians at a time, before they are rendered",
    "render/hash_grid.py": "features of points, which no rendering of Gaussians has",
    "render/moved.py": "Gaussians at a time, before they are rendered again",
    "render/replay.py": "the number of pairs of a rendering",
    "render/trace.py": "rays through meshes, which share nothing with a rendering",
    "render/surface.py": "surfaces from images of a rendering",
}
KNOWS_STREAMS = {  # streams, events and graphs of torch
    "render/cuda.py": "the one module of streams, events and graphs",
}
KNOWS_KINDS = {
    "render/buffers.py": "the shape of a tile depends on the kind of device, which is the input's"
}
MAX_CLASS_LINES, MAX_ATTRIBUTES = 150, 15
LARGE_CLASSES = {  # file:class: why it may be larger
    "kernels/geometry.py:CameraView": "a camera as kernels read it: one number a field",
    "data/specs.py:Field": "what a file format says about one field: independent facts, all but "
    "the name optional",
    "data/sequence.py:Sequence": "what a recording may contain, a field for each kind of image",
    "scene/sensor.py:Sensor": "the physical constants of one camera, each independent of the "
    "others",
    "render/replay.py:Replay": "still to be divided",
    "sim/scene.py:Scene": "what a scene file may say",
    "recon/settings.py:ReconSettings": "settings of one run; those that belong together are "
    "classes of their own",
    "recon/runs/base.py:Run": "public, and half of it what its arguments and errors are",
    "render/buffers.py:Buffers": "still to be divided",
}
SENTINEL = re.compile(r"(?<![\w.+*/-])-?\d+(\.\d+)?(: | likewise| (if|where|for|means) )")
SENTINELS = {  # kernel.parameter or struct.field: why a number may mean something else there
    "resolve_geometry.factor": "a factor that is multiplied with; the comment says which two "
    "there are",
    "add_records.geometry_only": "a flag",
    "add_statistics.counts": "a flag",
    "finish_step.weights": "a term with weight 0 adds nothing",
    "project.box_px": "a box without pixels is a splat that is culled: nothing compares it with 0",
    "backward.slopes": "what a row of the list without a number gets, not what it means",
    "number_pairs.owners": "what is written where no pair is, and read by nobody",
    "trace_hits.body": "the constant NOTHING",
    "Emitter.power": "cosine ** 0 is 1: the limit, and no case",
}
HOMELESS = {"utils", "util", "common", "misc", "types", "helpers"}


def name_of(path):
    """A file of the package as people write it: room/file."""
    return str(path.relative_to(ROOT))


def room_of(path):
    """The folder of a module inside the package, or its file name at the top level."""
    return path.relative_to(ROOT).parts[0]


def each(things, name_of):
    """Make a check of one thing a test of all of them, which names every one that fails: thousands
    of parametrised tests would take longer to start and report than to run.
    """

    def decorate(check):
        def test():
            wrong = []
            for thing in things:
                try:
                    check(thing)
                except AssertionError as error:
                    wrong.append(f"{name_of(thing)}: {error}")
            assert not wrong, "\n".join(wrong)

        test.__name__, test.__doc__ = check.__name__, check.__doc__
        return test

    return decorate


@functools.cache
def nodes_of(path):
    """The syntax tree of a file, and all nodes below."""
    return [*ast.walk(ast.parse(path.read_text()))]


@pytest.fixture(scope="module", autouse=True)
def forgotten():
    """The trees are large: they go with the last test."""
    yield
    nodes_of.cache_clear()


def imports(nodes, path):
    """Yield every absolute dotted name that statements import."""
    package = ["gftorf_warp", *path.relative_to(ROOT).parts[:-1]]
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (a.name for a in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            yield from (".".join([*base, *filter(None, [node.module]), a.name]) for a in node.names)


def module_level_imports(path):
    """Yield what is imported as soon as the module is:
    outside functions and outside ``if TYPE_CHECKING``.
    """
    for node in nodes_of(path)[0].body:
        if not isinstance(node, ast.FunctionDef | ast.ClassDef | ast.If):
            yield from imports(ast.walk(node), path)


@each(FILES, name_of)
def test_module_imports_what_its_room_may(path):
    """No upward import, no package the room does not need,
    nothing heavy before a function needs it.
    """
    room = room_of(path)
    top_level = path.parent == ROOT
    assert room in TABLE or top_level, f"{room}/ is not in the table: say what it may import"
    # cli.py and its like see every room
    rooms, packages = TABLE.get(room, (TABLE.keys(), TORCH | {"warp"}))
    names = list(imports(nodes_of(path), path))
    for top, *rest in (name.split(".") for name in names):
        if top != "gftorf_warp":
            assert top in packages | set(sys.stdlib_module_names), f"{room} must not import {top}"
        elif rest and not top_level:
            assert rest[0] in {*rooms, room, *FREE}, f"{room} must not import {rest[0]}"
    for top, *rest in (name.split(".") for name in module_level_imports(path)):
        assert top not in INSIDE_FUNCTIONS, f"import {top} inside the functions that use it"
        if top_level and top == "gftorf_warp" and rest:
            assert rest[0] not in TABLE or rest[0] in FREE, (
                f"import {rest[0]} inside functions: --help stays instant"
            )
        assert not top_level or top == "gftorf_warp" or top in sys.stdlib_module_names, (
            f"import {top} inside functions"
        )
    if name_of(path) not in HAS_BOTH and not top_level:
        assert not {"torch", "warp"} <= {n.partition(".")[0] for n in names}, (
            f"only {[*HAS_BOTH]} know torch and Warp"
        )


@each(FILES, name_of)
def test_module_names_no_device_and_launches_nowhere_else(path):
    """Devices are named by the command line; kernels are launched where ``LAUNCHES`` says,
    streams likewise.
    """
    name, below = name_of(path), path.parent != ROOT
    for node in nodes_of(path):
        if below:
            named = getattr(node, "attr", None) == "cuda" and name not in KNOWS_STREAMS
            assert not named, f"line {node.lineno}: follow the device of the input"
            text = (
                node.value if isinstance(node, ast.Constant) and name not in KNOWS_KINDS else None
            )
            assert not (isinstance(text, str) and re.fullmatch(r"cuda(:\d+)?", text)), (
                f"line {node.lineno}: {text}"
            )
        if name not in LAUNCHES:
            assert getattr(node, "attr", None) not in {"launch", "launch_tiled"}, (
                f"line {node.lineno}: a launch"
            )


@each(FILES, name_of)
def test_file_is_a_page_or_a_few(path):
    """A file is one idea, and has a name that says which."""
    text = path.read_text()
    assert path.stem not in HOMELESS, "a function without a home is a concept without a name"
    lines = text.splitlines()
    assert len(lines) <= MAX_LINES or name_of(path) in LONG, (
        f"{len(lines)} lines: more than one idea?"
    )
    wide = [
        number
        for number, line in enumerate(lines, start=1)
        if len(line.partition("  # noqa")[0]) > MAX_COLUMNS
    ]
    assert not wide, f"more than {MAX_COLUMNS} columns in lines {wide}"


@each(FILES, name_of)
def test_everything_public_says_what_it_is(path):
    """Modules, public classes, their public methods and public functions have docstrings;
    so has each setting.
    """
    tree = nodes_of(path)[0]
    assert ast.get_docstring(tree), "say what the module is"
    for holder in [
        tree,
        *(n for n in tree.body if isinstance(n, ast.ClassDef) and not n.name.startswith("_")),
    ]:
        for node in holder.body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                # declares a function whose text is C++
                native = ast.unparse(node.body[-1]) == "..."
                assert native or ast.get_docstring(node), (
                    f"line {node.lineno}: {node.name} says nothing"
                )
        if isinstance(holder, ast.ClassDef) and any(
            "frozen" in ast.unparse(d) for d in holder.decorator_list
        ):
            for node, after in zip(holder.body, [*holder.body[1:], None], strict=True):
                if isinstance(node, ast.AnnAssign):
                    text = after.value if isinstance(after, ast.Expr) else None
                    where = f"line {node.lineno}: {ast.unparse(node.target)}"
                    assert isinstance(text, ast.Constant), (
                        f"{where} needs a docstring under it, with its unit"
                    )


def kernels():
    """Yield every @wp.kernel of the package, also those that a factory makes."""
    for path in FILES:
        text = path.read_text()
        for node in nodes_of(path) if "@wp.kernel" in text else ():
            if isinstance(node, ast.FunctionDef) and any(
                "kernel" in ast.unparse(d) for d in node.decorator_list
            ):
                yield path, node


def comment_of(source, number):
    """The comment behind a line of code, with the lines below that continue it after two spaces."""
    comment = source[number - 1].partition("#")[2]
    for line in source[number:]:
        if not line.strip().startswith("#  "):
            break
        comment += " " + line.strip()[1:].strip()
    return comment


KERNELS = list(kernels())


@each(KERNELS, lambda kernel: f"{kernel[0].stem}.{kernel[1].name}")
def test_kernel_signature_is_readable(kernel):
    """Kernels live in kernels/, list inputs then outputs,
    type every parameter and say its [shape] or [unit].
    """
    path, node = kernel
    assert room_of(path) == "kernels"
    source = path.read_text().splitlines()
    signature = [line.strip() for line in source[node.lineno : node.body[0].lineno - 1]]
    # two spaces continue a comment
    headings = [line for line in signature if re.match(r"# ?\S", line)]
    assert headings == ["# In:", "# Out:"]
    for arg in node.args.args:
        assert arg.annotation is not None, f"{arg.arg}: state its type"
        assert "[" in comment_of(source, arg.lineno), (
            f"{arg.arg}: say its shape or unit in brackets"
        )
    assert ast.get_docstring(node), "say what one thread does"


def test_there_are_kernels_to_look_at():
    """The test above reads what it finds; finding nothing must not pass."""
    assert len(KERNELS) >= 8


def module_of(path):
    """The dotted name under which a file is imported."""
    return ".".join(["gftorf_warp", *path.relative_to(ROOT).with_suffix("").parts]).removesuffix(
        ".__init__"
    )


def import_graph():
    """Modules of the package that each module imports."""
    modules = {module_of(path): path for path in FILES}
    graph = {}
    for module, path in modules.items():
        graph[module] = set()
        for name in imports(nodes_of(path), path):
            parts = name.split(".")  # what is imported may be a name inside a module
            above = {".".join(parts[:n]) for n in range(2, len(parts) + 1)} & modules.keys()
            graph[module] |= {max(above, key=len)} - {module} if above else set()
    return graph


def circles(graph):
    """Sets of modules that reach each other: strongly connected components of more than one
    module.
    """
    reached = {}
    for start in graph:
        todo, seen = list(graph[start]), set()
        while todo:
            module = todo.pop()
            if module not in seen:
                seen.add(module)
                todo += graph[module]
        reached[start] = seen
    found = {
        frozenset(other for other in reached[m] if m in reached[other])
        for m in graph
        if m in reached[m]
    }
    return {
        tuple(sorted(module.removeprefix("gftorf_warp.") for module in circle)) for circle in found
    }


def test_circles_are_found():
    """The search sees a circle, also one of several modules,
    and no circle where two ways lead to one module.
    """
    assert circles({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == set()
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}}) == {("b", "c")}


def test_no_module_imports_itself_by_a_detour():
    """No circle of imports, be they at the top of a file,
    inside a function or for the type checker alone.
    """
    found = circles(import_graph())
    assert not found, f"import circles: {found}"


def attributes(node):
    """Names that a class gives its instances: annotated fields,
    and ``self.x`` that is assigned in a method.
    """
    names = {ast.unparse(field.target) for field in node.body if isinstance(field, ast.AnnAssign)}
    for below in ast.walk(node):
        if isinstance(below, ast.Attribute) and isinstance(below.ctx, ast.Store):
            names |= {below.attr} if ast.unparse(below.value) == "self" else set()
    return names


@each(FILES, name_of)
def test_class_is_small(path):
    """A class has at most 150 lines and 15 attributes; more are several ideas."""
    for node in nodes_of(path):
        if isinstance(node, ast.ClassDef):
            lines, count = node.end_lineno - node.lineno + 1, len(attributes(node))
            small = lines <= MAX_CLASS_LINES and count <= MAX_ATTRIBUTES
            assert small or f"{name_of(path)}:{node.name}" in LARGE_CLASSES, (
                f"{node.name}: {lines} lines, {count} attributes"
            )


def test_no_exception_is_kept_for_a_class_that_became_small():
    """``LARGE_CLASSES`` names classes that exist and are large."""
    classes = {
        f"{name_of(path)}:{node.name}": node
        for path in FILES
        if any(name.startswith(f"{name_of(path)}:") for name in LARGE_CLASSES)
        for node in nodes_of(path)
        if isinstance(node, ast.ClassDef)
    }
    for name in LARGE_CLASSES:
        node = classes.get(name)
        large = node and (
            node.end_lineno - node.lineno >= MAX_CLASS_LINES
            or len(attributes(node)) > MAX_ATTRIBUTES
        )
        assert large, f"{name} is small now: take it from LARGE_CLASSES"


OTHERS = (
    "self|cls|os|torch|wp"  # whose private names a test may use: its own, and those of libraries
)
PRIVATE = re.compile(rf"(?<![\w.])(?!({OTHERS})\b)[a-zA-Z]\w*(\.\w+)*\._(?!_|replace\b)[a-z]")


@each(sorted((REPOSITORY / "tests").glob("*.py")), lambda path: path.name)
def test_tests_use_no_private_names(path):
    """Tests are of behaviour: a name that begins with an underscore may change at any time."""
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        code = re.sub(r"\"[^\"]*\"", "", line.partition("#")[0])
        assert not PRIVATE.search(code), f"line {number}: {line.strip()}"


def device_values():
    """Yield (name, comment) of the parameters of all kernels and of the fields of all structs of
    Warp.
    """
    for path in FILES:
        text = path.read_text()
        if "@wp." not in text:
            continue
        source = text.splitlines()
        for node in nodes_of(path):
            kinds = "".join(map(ast.unparse, getattr(node, "decorator_list", [])))
            if isinstance(node, ast.FunctionDef) and "kernel" in kinds:
                values = [(arg.arg, arg.lineno) for arg in node.args.args]
            elif isinstance(node, ast.ClassDef) and "struct" in kinds:
                values = [
                    (f.target.id, f.lineno) for f in node.body if isinstance(f, ast.AnnAssign)
                ]
            else:
                continue
            for name, line in values:
                yield f"{node.name}.{name}", comment_of(source, line)


def test_no_number_means_something_else():
    """No parameter of a kernel has a number that means another thing, such as "-1: none".

    A flag, another kernel, an array without elements or a constant with a name says the same
    without a legend.
    """
    sentinels = {where for where, comment in device_values() if SENTINEL.search(comment)}
    assert sentinels <= SENTINELS.keys(), (
        f"a number with a meaning of its own: {sentinels - SENTINELS.keys()}"
    )
    assert SENTINELS.keys() <= sentinels, (
        f"no more: take them from SENTINELS: {SENTINELS.keys() - sentinels}"
    )


@each([p for p in FILES if room_of(p) == "kernels"], name_of)
def test_kernels_compare_with_no_nameless_negative_number(path):
    """``x == -1`` asks for a meaning that only a legend has; a constant has a name."""
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        assert not re.search(r"(==|!=) *-\d", line.partition("#")[0]), (
            f"line {number}: {line.strip()}"
        )


@each(sorted({p.parent for p in FILES if room_of(p) == "kernels"}), name_of)
def test_a_folder_of_kernels_lists_its_files(folder):
    """Docstrings of kernels/ and of its folders name every file and folder,
    and nothing that is not there.
    """
    text = ast.get_docstring(ast.parse((folder / "__init__.py").read_text()))
    lines = {*re.findall(r"^ *(\w+) {2,}\S", text, flags=re.MULTILINE)}
    there = {
        p.stem
        for p in folder.iterdir()
        if (p.suffix == ".py" or p.is_dir()) and not p.name.startswith("__")
    }
    missing = there - lines - {*re.findall(r"``(\w+)``", text)}
    assert not missing, (
        f"{name_of(folder)}/__init__.py has no line `name  what it does` for {sorted(missing)}"
    )
    assert lines <= there, f"{name_of(folder)}/__init__.py lists {sorted(lines - there)}"


def operators(module):
    """Public functions that a module defines, by name."""
    found = inspect.getmembers(module, inspect.isfunction)
    return {
        name: f for name, f in found if f.__module__ == module.__name__ and not name.startswith("_")
    }


def test_every_operator_has_an_oracle():
    """A public operator and its plain-torch twin take the same arguments,
    so that a test can call both alike.
    """
    assert "rasterize" in operators(api)
    for name, operator in operators(api).items():
        twin = getattr(reference, name, None)
        assert twin is not None, f"render/reference.py lacks {name}"
        got, want = inspect.signature(twin).parameters, inspect.signature(operator).parameters
        assert [*got] == [*want], name
        assert [p.kind for p in got.values()] == [p.kind for p in want.values()], name


def test_the_package_keeps_its_promises_at_the_top():
    """Every public name exists where the package says, and has a docstring."""
    package = importlib.import_module("gftorf_warp")
    for name in package.__all__:
        thing = getattr(package, name)
        assert name == "__version__" or inspect.getdoc(thing), name


def texts():
    """Every text file that belongs to the repository, whether or not git is at hand."""
    folders = [
        REPOSITORY / name
        for name in (".ci", "benchmarks", "data_specs", "design", "examples", "tests")
    ]
    found = [path for folder in [ROOT, *folders] for path in folder.rglob("*")]
    found += [path for path in REPOSITORY.iterdir() if path.suffix in {".md", ".toml", ".txt"}]
    binary = {".pyc", ".npy", ".png", ".exr", ".jpg"}
    return [
        p for p in found if p.is_file() and p.suffix not in binary and "__pycache__" not in p.parts
    ]


def test_no_path_of_any_machine():
    """What runs here must run elsewhere: no absolute path of a developer's machine."""
    folders = "|".join(("work", "root", "farm", "home", "Users"))
    machine = re.compile(rf"(^|[^A-Za-z0-9_./~-])/({folders})/")
    assert machine.search("see /" + "work/shared")
    for path in texts():
        for number, line in enumerate(path.read_text(errors="replace").splitlines(), start=1):
            assert not machine.search(line), (
                f"{path.relative_to(REPOSITORY)}:{number}: {line.strip()}"
            )


def test_the_documents_know_the_rooms():
    """ARCHITECTURE.md names every room with what it may import;
    a new room cannot be forgotten there.
    """
    lines = (REPOSITORY / "ARCHITECTURE.md").read_text().splitlines()
    rows = {
        cells[1].strip(" `*"): cells
        for cells in (line.split("|") for line in lines)
        if len(cells) == 6
    }
    for room, (rooms, packages) in TABLE.items():
        if room.endswith(".py"):
            continue
        assert room in rows, f"ARCHITECTURE.md has no row for {room}"
        words = {word for cell in rows[room][2:4] for word in re.findall(r"\w+", cell)}
        assert rooms <= words, f"{room}: ARCHITECTURE.md does not list {rooms - words}"
        assert packages <= words, f"{room}: ARCHITECTURE.md does not list {packages - words}"


def test_the_first_pages_show_their_commands():
    """README.md, of a page, starts from nothing; the quick start has every command in a table."""
    from gftorf_warp.options import command_parsers

    text = (REPOSITORY / "README.md").read_text()
    assert len(text.splitlines()) <= 80
    assert "pip install -c constraints.txt ." in text
    assert "pip install -c constraints.txt '.[test]'" in text
    assert "pytest" in text
    table = (REPOSITORY / "docs" / "quick-start.md").read_text()
    for command in command_parsers():
        assert f"| `gftorf {command}" in table, command


def test_every_pinned_version_is_exact_and_ordinary():
    """constraints.txt pins every direct dependency, without local builds or files."""
    import tomllib

    pins = {}
    for line in (REPOSITORY / "constraints.txt").read_text().splitlines():
        if line and not line.startswith("#"):
            match = re.fullmatch(r"([A-Za-z0-9_.-]+)==([0-9][0-9a-z.]*)", line)
            assert match, f"not NAME==VERSION: {line}"
            pins[normal(match[1])] = match[2]
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
    direct = [*project["project"]["dependencies"], *project["build-system"]["requires"]]
    direct += [
        name for extra in project["project"]["optional-dependencies"].values() for name in extra
    ]
    for requirement in direct:
        name = normal(re.match(r"[A-Za-z0-9_.-]+", requirement)[0])
        assert name == "gftorf-warp" or name in pins, f"{requirement} is not pinned"


def normal(name):
    """The name of a package as indexes compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()
