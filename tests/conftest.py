"""How tests are spread over processes: a file's tests stay together, so that what they share is
made once, and the longest files begin first. Which tests go without the check of shapes.
"""

import os

import jaxtyping
import pytest

# Several processes of pytest-xdist share the cores; threads of torch, two in each, would wait for
# each other. Here, because OpenMP reads it when torch is imported.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")

# Nothing is checked behind pages, command lines, readers and writers; kernels, simulations and long
# fits would take a fifth longer, behind what other tests check.
UNCHECKED = {
    f"test_{name}.py"
    for name in """
    accuracy architecture attempts bad_command_lines bench bounces capture check cli collapse
    contact_sheet cycles_recon damaged_files damaged_runs demo doctests engines examples
    export_picture files ftorf ftorf_errors ftorf_write full_disk grid_volume import
    import_archives import_arrays import_chain import_colour import_keys import_lens import_page
    import_phasors import_poses kills ladder light_parts listed_rows look_alikes meshes
    moving_camera processes promises public_api readme reconstruct report reproduce resources
    resume scene_page shared_batches simulate soak spoiled static_phasor stepper suitable sweep
    tile_bitmask tiles torf torf_errors trace trace_shapes unfinished video view waveform
    wgmma_by_threads world writers
    """.split()
}

# The files that take longest, the longest first: what begins last must be short, or a core has
# nothing to do meanwhile. xdist itself begins with the files of most tests.
LONGEST = """
    sweep reconstruct volumes splat_distance published_runs look_alikes accuracy listed_rows
    bench stepper bounces import_chain rasterize lens long simulate view cycles_recon unfinished
    resume best tensor_cores perceptron processes random_scene attempts moving_camera windows
    collapse damaged_files planted_mistakes
    """.split()


def pytest_collection_modifyitems(items):
    """Sort by file."""
    order = {f"test_{name}.py": n for n, name in enumerate(LONGEST)}
    items.sort(key=lambda item: order.get(item.path.name, len(order)))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """By file instead of one by one, unless ``--dist`` asks for something else."""
    from xdist.scheduler import LoadFileScheduling

    if config.getvalue("dist") != "load":
        return None
    config.option.loadscopereorder = False
    return LoadFileScheduling(config, log)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    """With --jaxtyping-packages, check shapes; `contract` passes wrong ones on purpose."""
    marked = any(item.get_closest_marker(name) for name in ("contract", "slow"))
    before = jaxtyping.config.jaxtyping_disable
    unchecked = before or marked or item.path.name in UNCHECKED
    jaxtyping.config.update("jaxtyping_disable", unchecked)
    try:
        return (yield)
    finally:
        jaxtyping.config.update("jaxtyping_disable", before)
