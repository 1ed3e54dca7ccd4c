"""Rows without gradient left out of a network's way back: the list, slopes and weight gradients by
it, nothing else.

What a GPU runs is executed by threads of a CPU, see test_wgmma_by_threads.py, and compared with the
CPU's own way.
"""

import numpy as np
import pytest
import torch
from small_runs import random
from test_perceptron import compare_replay, gradients, half, network
from test_tensor_cores import DEVICES, FULL, ON_HOPPER, SHAPES, inputs_of, launched, pair, rows
from test_wgmma_by_threads import BACKWARD, BLOCKS, COMPILER, FORWARD, run, stored

from gftorf_warp.kernels.network import gradient_rows as lists
from gftorf_warp.kernels.network import parameter_gradients as ends
from gftorf_warp.kernels.network import weight_gradients, wgmma
from gftorf_warp.render import tensor_cores
from gftorf_warp.render.bridge import array_over
from gftorf_warp.render.layers import Form
from gftorf_warp.render.tensor_cores import FusedLayers
from gftorf_warp.scene.motion import MotionSettings

WIDTH, TILE = wgmma.WIDTH, wgmma.TILE
BY_THREADS = pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")

LIST = """
static void count_block(wp::array_t<float> gradient, int count, int block,
    wp::array_t<int> counts) { COUNT }
static void list_block(wp::array_t<float> gradient, wp::array_t<int> counts, int count, int block,
                       wp::array_t<int> listed, wp::array_t<int> begins) { CODE }
int main(int, char** given) {
    const int keys = std::atoi(given[1]), count = std::atoi(given[2]);
    auto gradient = loaded<float>("gradient");
    const int blocks = keys * ((count + 255) / 256);
    std::vector<int> counts(blocks, -9), listed(keys * ((count + 63) / 64) * 64, -9),
        begins(keys + 1, -9);
    on_blocks(blocks, [&] { count_block({gradient.data()}, count, blockIdx.x, {counts.data()}); });
    on_blocks(blocks, [&] {
        list_block({gradient.data()}, {counts.data()}, count, blockIdx.x, {listed.data()},
            {begins.data()});
    });
    stored("listed", listed); stored("begins", begins);
}
"""
WEIGHTS = """
static void multiply(int block, int jobs, int parts, int keys, int count, int capacity, int joined,
                     wp::array_t<int> listed, wp::array_t<int> begins, wp::array_t<wp::half> slopes,
                     wp::array_t<wp::half> inputs, wp::array_t<float> partials) { CODE }
int main(int, char** given) {
    const int jobs = std::atoi(given[1]), parts = std::atoi(given[2]), keys = std::atoi(given[3]);
    const int count = std::atoi(given[4]), joined = std::atoi(given[5]), columns =
        std::atoi(given[6]);
    auto listed = loaded<int>("listed"), begins = loaded<int>("starts");
    // copies of 16 bytes are aligned as they are in the memory of a device
    auto aligned = [](const std::vector<wp::half>& from) {
        auto* const to = (wp::half*)std::aligned_alloc(64, (2 * from.size() + 63) / 64 * 64);
        std::copy(from.begin(), from.end(), to); return to;
    };
    auto* const slopes = aligned(loaded<wp::half>("slopes"));
    auto* const inputs = aligned(loaded<wp::half>("inputs"));
    std::vector<float> partials((size_t)jobs * parts * 128 * columns, NAN);
    on_blocks(jobs * parts, [&] {
        multiply(blockIdx.x, jobs, parts, keys, count, listed.size(), joined, {listed.data()},
            {begins.data()},
                 {slopes}, {inputs}, {partials.data()});
    });
    stored("partials", partials);
}
"""
HEADS = """
static void multiply(int part, int parts, int keys, int layers, int rows, wp::array_t<int> listed,
                     wp::array_t<int> begins, wp::array_t<wp::half> after,
                         wp::array_t<wp::half> outputs,
                     wp::array_t<float> partials) { CODE }
int main(int, char** given) {
    const int parts = std::atoi(given[1]), keys = std::atoi(given[2]), layers = std::atoi(given[3]);
    auto listed = loaded<int>("listed"), begins = loaded<int>("starts");
    auto after = loaded<wp::half>("after"), outputs = loaded<wp::half>("outputs");
    std::vector<float> partials((size_t)parts * 768, NAN);
    on_blocks(parts, [&] {
        multiply(blockIdx.x, parts, keys, layers, after.size() / 8, {listed.data()},
            {begins.data()}, {after.data()},
                 {outputs.data()}, {partials.data()});
    });
    stored("partials", partials);
}
"""


def hidden(gradient, share, keys, *, seed=4):
    """Zeros in a share of the rows, of each sign; of the first row of the last key only one value
    is left.
    """
    found = gradient.clone()
    drawn = random(len(gradient), 1, seed=seed).to(gradient.device)
    found = torch.where(drawn < share, found.sign() * 0.0, found)
    if 0 < share < 1:
        found[(keys - 1) * len(found) // keys] = torch.tensor([0.0, -0.0, 1e-6])
    return found


def wanted(gradient, keys):
    """The list, and where keys begin in it, by torch."""
    listed, begins = [], [0]
    for key, part in enumerate(gradient.cpu().view(keys, -1, 3)):
        own = (part != 0).any(1).nonzero()[:, 0] + key * len(part)
        listed += [*own.tolist(), *[-1] * (-len(own) % TILE)]
        begins.append(len(listed))
    return listed, begins


def read(path, dtype):
    """An array that a program wrote."""
    return torch.from_numpy(np.fromfile(path, dtype))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    ("keys", "count"), [(1, 1), (2, 33), (3, 64), (2, 300), (3, 1_000), (3, 20_480)]
)
@pytest.mark.parametrize("share", [0.0, 0.6, 1.0])
def test_a_list_is_in_order_and_whole_tiles(keys, count, share, device):
    """Key by key; also where everybody has a gradient, or nobody."""
    gradient = hidden(random(keys * count, 3, seed=2).to(device) - 0.5, share, keys)
    listed, begins = tensor_cores.listed_rows(gradient, keys)
    want, ends = wanted(gradient, keys)
    assert begins.tolist() == ends
    assert listed[: ends[-1]].tolist() == want
    assert len(listed) == lists.capacity(keys, count) >= len(want)
    assert share < 1 or ends[-1] == 0


def test_what_is_no_number_has_a_gradient():
    """So that the step is found not to be sound."""
    gradient = torch.zeros(70, 3)
    gradient[3, 1], gradient[66, 2] = torch.nan, -torch.inf
    listed, _ = tensor_cores.listed_rows(gradient, 2)
    assert listed[listed >= 0].tolist()[:2] == [3, 66]


@BY_THREADS
@pytest.mark.parametrize(("keys", "count"), [(1, 33), (3, 600)])
def test_a_list_by_blocks_of_threads(keys, count, tmp_path):
    """The code for CUDA, several blocks of rows and keys."""
    gradient = hidden(random(keys * count, 3, seed=2) - 0.5, 0.6, keys)
    stored(tmp_path, gradient=gradient.numpy())
    run(
        tmp_path,
        LIST.replace("COUNT", lists.count_block.native_snippet),
        lists.list_block,
        keys,
        count,
    )
    want, ends = wanted(gradient, keys)
    assert read(tmp_path / "begins", np.int32).tolist() == ends
    assert read(tmp_path / "listed", np.int32)[: ends[-1]].tolist() == want


@BY_THREADS
@pytest.mark.parametrize(
    ("layers", "skip_after", "count", "keys", "share"),
    [(8, 5, 33, 1, 0.0), (3, 1, 200, 4, 0.3), (2, 1, 64 * 2 * wgmma.ROUND + 65, 1, 0.0)],
    ids=["a tile", "keys", "a tile more than a round"],
)
def test_slopes_by_a_block_of_threads(layers, skip_after, count, keys, share, tmp_path):
    """Slopes and sums of two blocks are the CPU's, by the masks that a GPU has."""
    made = network(half(MotionSettings(layers=layers, skip_after=skip_after)))
    form, place, moment, all_weights, biases = inputs_of(made, count, keys)
    forth, _, _, shifts = tensor_cores.packed(form, moment, all_weights, biases)
    numbers = layers, form.entries[-1], keys, count
    stored(tmp_path, place=place.numpy(), forth=forth.numpy(), shifts=shifts.numpy())
    run(tmp_path, FORWARD, wgmma.rows_forward, *numbers)
    outputs = read(tmp_path / "outputs", np.float16).view(layers, keys * count, WIDTH)
    gradient = hidden(random(keys * count, 3, seed=3) - 0.5, share, keys)
    if keys > 2:  # a key without rows between two with some, in one block
        gradient[count : 2 * count] = 0.0
    kept = FusedLayers().forward(form, place, moment, all_weights, biases)[2]
    slopes = FusedLayers().backward(form, keys, gradient, outputs, kept)
    end = int(slopes.begins[-1])
    assert slopes.begins.tolist() == wanted(gradient, keys)[1]
    stored(tmp_path, after=slopes.head.numpy(), head=all_weights[-1].numpy(), back=kept[0].numpy())
    stored(tmp_path, listed=slopes.listed.numpy(), starts=slopes.begins.numpy())
    run(tmp_path, BACKWARD, wgmma.listed_backward, *numbers)
    same = read(tmp_path / "slopes", np.float16).view(layers, -1, WIDTH)
    torch.testing.assert_close(same[:, :end], slopes.layers[:, :end], rtol=5e-3, atol=2e-3)
    assert same[:, end:].isnan().all(), "nothing is written behind the last row"
    nobody = slopes.listed[:end] < 0
    assert nobody.any()
    assert same[:, :end][:, nobody].abs().max() == 0
    partials = read(tmp_path / "partials", np.float32).view(
        layers, keys, BLOCKS * wgmma.GROUPS, WIDTH
    )
    scale = float(slopes.sums.abs().max())
    torch.testing.assert_close(partials.sum(2), slopes.sums, rtol=2e-3, atol=2e-4 * scale)
    assert float(slopes.layers[:, :end].abs().max()) > 1


@BY_THREADS
@pytest.mark.parametrize("columns", [WIDTH, wgmma.COLUMNS])
@pytest.mark.parametrize(("keys", "count", "parts"), [(2, 600, 3), (2, 250, 1), (1, 40, 2)])
def test_weight_gradients_by_blocks_of_threads(columns, keys, count, parts, tmp_path):
    """Parts of a list longer than what shared memory holds, and an empty one: added up they are d^T
    h in float64.

    What no row may be is no number here: outputs of rows that are not listed, and slopes behind the
    list.
    """
    layers, joined = 3, 2
    gradient = hidden(random(keys * count, 3, seed=2) - 0.5, 0.3, keys)
    gradient.view(keys, count, 3)[:, 0] = 0.0  # what is read in place of no row
    listed, begins = wanted(gradient, keys)
    capacity = lists.capacity(keys, count)
    slopes = torch.full((layers, capacity, WIDTH), torch.nan, dtype=torch.float16)
    slopes[:, : begins[-1]] = random(layers, begins[-1], WIDTH, seed=5) - 0.5
    at = torch.tensor(listed)
    slopes[:, : begins[-1]][:, at < 0] = 0.0
    if columns == WIDTH:
        inputs, jobs, rows_of = (
            random(layers, keys * count, WIDTH, seed=6) - 0.3,
            2 * (layers - 1),
            keys * count,
        )
        inputs[:, (gradient == 0).all(1)] = torch.nan
        factors = [(slopes[n + 1], inputs[n].half()[at]) for n in range(layers - 1)]
    else:
        inputs, jobs, rows_of = random(count, columns, seed=6) - 0.3, 4, count
        inputs[0] = torch.nan
        factors = [(slopes[n], inputs.half()[at % count]) for n in (0, joined)]
    stored(
        tmp_path,
        listed=np.pad(np.array(listed, np.int32), (0, capacity - len(listed)), constant_values=-7),
    )
    stored(
        tmp_path,
        starts=np.array(begins, np.int32),
        slopes=slopes.numpy(),
        inputs=inputs.half().numpy(),
    )
    way = weight_gradients.by_outputs if columns == WIDTH else weight_gradients.by_positions
    run(tmp_path, WEIGHTS, way, jobs, parts, keys, rows_of, joined, columns)
    found = read(tmp_path / "partials", np.float32).view(parts, -1, WIDTH, columns)
    for result, (left, right) in zip(found.sum(0), factors, strict=True):
        there = at >= 0
        want = left[: begins[-1]][there].double().T @ right[there].double()
        torch.testing.assert_close(result.double(), want, rtol=1e-4, atol=1e-4)
        assert float(want.abs().max()) > 1
    tiles = begins[-1] // TILE
    assert found[0].abs().max() > 0 or tiles < parts
    assert tiles > parts * weight_gradients.STAGES or tiles == 1


@BY_THREADS
@pytest.mark.parametrize(("keys", "count", "parts"), [(2, 600, 3), (1, 40, 2)])
def test_the_heads_weight_by_blocks_of_threads(keys, count, parts, tmp_path):
    """The code for CUDA: parts added up are what float64 has of listed rows;
    nobody reads the others.
    """
    gradient = hidden(random(keys * count, 3, seed=2) - 0.5, 0.3, keys)
    listed, begins = wanted(gradient, keys)
    there = (gradient != 0).any(1)
    after = torch.zeros(keys * count, wgmma.HEAD)
    after[:, :3] = gradient
    after[~there] = torch.nan
    outputs = random(2, keys * count, WIDTH, seed=6) - 0.3
    outputs[0], outputs[1, ~there] = torch.nan, torch.inf
    padded = np.pad(
        np.array(listed, np.int32),
        (0, lists.capacity(keys, count) - len(listed)),
        constant_values=-7,
    )
    stored(tmp_path, listed=padded, starts=np.array(begins, np.int32))
    stored(tmp_path, after=after.half().numpy(), outputs=outputs.half().numpy())
    run(tmp_path, HEADS, ends.by_head, parts, keys, 2)
    found = read(tmp_path / "partials", np.float32).view(parts, 3, WIDTH)
    want = after[there, :3].half().double().T @ outputs[1, there].half().double()
    torch.testing.assert_close(found.double().sum(0), want, rtol=1e-5, atol=1e-5)
    assert float(want.abs().min()) > 1e-4
    assert found.abs().amax((1, 2)).count_nonzero() == min(parts, begins[-1] // TILE)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("shape", SHAPES)
def test_nobody_reads_rows_that_are_not_listed(shape, device):
    """Whatever is in them, in the last layer as well: the same weight gradients, to the bit."""
    made, _ = pair(SHAPES[shape], device)
    form, place, moment, all_weights, biases = inputs_of(made, 40, 2)
    passes = FusedLayers()
    gradient = hidden(random(80, 3, seed=3) - 0.5, 0.6, 2).to(device)
    outputs, _, kept = passes.forward(form, place, moment, all_weights, biases)
    slopes = passes.backward(form, 2, gradient, outputs, kept)
    want = passes.parameter_gradients(form, place, moment, slopes, outputs)
    outputs[:, (gradient == 0).all(1)] = torch.inf
    found = passes.parameter_gradients(form, place, moment, slopes, outputs)
    assert [value.shape for value in found] == [
        v.shape for both in zip(all_weights, biases, strict=True) for v in both
    ]
    assert all(map(torch.equal, found, want))
    assert all(value.isfinite().all() and value.abs().max() > 0 for value in found)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("keys", "parts"), [(1, 1), (3, 4)])
def test_parts_and_sums_become_gradients(shape, keys, parts, device):
    """Every value has its place, its parts and the scale; the bias of the head has none."""
    form = Form.of(network(half(SHAPES[shape])))
    layers, halves, columns = SHAPES[shape].layers, weight_gradients.HALVES, wgmma.COLUMNS
    drawn = [
        (layers, keys, WIDTH), (3,), (keys, form.time),
        (parts, halves * (layers - 1), weight_gradients.HALF * WIDTH),
        (parts, halves * len(form.entries), weight_gradients.HALF * columns), (parts, 1, 3 * WIDTH),
    ]  # fmt: skip
    sums, total, moment, outputs, places, head = (
        (random(*size, seed=8) - 0.4).to(device) for size in drawn
    )
    unit = torch.tensor([0.25], device=device)
    shapes = tensor_cores.parameter_shapes(form, layers)
    found = torch.full((sum(np.prod(size) for size in shapes),), torch.nan, device=device)
    given = [array_over(value) for value in (unit, sums, total, moment, outputs, places, head)]
    dim = layers * WIDTH + 3, WIDTH + form.position + form.time + 1
    launched(
        ends.collect,
        dim,
        [tensor_cores.sizes_of(form, layers), *given],
        [array_over(found)],
        device,
    )
    square = outputs.sum(0).view(layers - 1, WIDTH, WIDTH)
    entered = dict(
        zip(
            form.entries, places.sum(0).view(-1, WIDTH, columns)[:, :, : form.position], strict=True
        )
    )
    want = []
    for number in range(layers):
        pieces = [square[number - 1]] if number else []
        if number in entered:
            pieces += [entered[number], sums[number].T @ moment]
        want += [0.25 * torch.cat(pieces, 1), 0.25 * sums[number].sum(0)]
    want += [0.25 * head.sum(0).view(3, WIDTH), total]
    assert [value.shape for value in want] == [torch.Size(size) for size in shapes]
    torch.testing.assert_close(
        found, torch.cat([value.flatten() for value in want]), rtol=1e-5, atol=1e-5
    )


@pytest.mark.parametrize("multiprocessors", [16, 78, 114, 132])
@pytest.mark.parametrize("layers", [1, 2, 3, 8])
@pytest.mark.parametrize("entries", [1, 2])
def test_all_blocks_run_at_once(multiprocessors, layers, entries):
    """The products' blocks fit beside each other, few multiprocessors have nothing to do,
    and shares are as work is.
    """
    own, others, left = weight_gradients.parts(multiprocessors, layers, entries)
    jobs = weight_gradients.HALVES * (layers - 1)
    assert own * jobs + left == multiprocessors
    assert own >= 1
    assert 0.7 * left < -(-others * weight_gradients.HALVES * entries // 2) <= left
    read, also = (
        jobs * (weight_gradients.HALF + WIDTH),
        weight_gradients.HALVES * entries * (weight_gradients.HALF + wgmma.COLUMNS),
    )
    assert (own + 1) * jobs > multiprocessors * read / (read + also) or not jobs
    assert own == 1 or own * jobs <= multiprocessors * read / (read + also)
    assert weight_gradients.parts(132, 8, 2) == (8, 10, 20)


def test_shared_memory_is_enough():
    """227 KB are all that a block can have, and of a multiprocessor's 228 each block takes one
    more.
    """
    assert (
        max(weight_gradients.shared(WIDTH), weight_gradients.shared(wgmma.COLUMNS), wgmma.SHARED)
        <= 227 * 1024
    )
    assert 2 * (weight_gradients.shared(wgmma.COLUMNS) + 1024) <= 228 * 1024


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("shape", SHAPES)
def test_gradients_are_those_of_all_rows(shape, device):
    """Rows without gradient add nothing: alone, the others give the same gradients,
    up to the order of their sums.
    """
    made, _ = pair(SHAPES[shape], device)
    gaussians, cotangent = rows(70, 2, device)
    drawn = hidden(cotangent[0], 0.6, 1)  # the same Gaussians at both keys
    cotangent = cotangent * (drawn != 0).any(1, keepdim=True)
    left = (cotangent != 0).any(2).all(0)
    alone = gaussians.map(lambda value: value[left])
    _, got = gradients(made, gaussians, cotangent, [0, 3])
    _, want = gradients(made, alone, cotangent[:, left], [0, 3])
    assert 0 < left.sum() < 70
    for one, other in zip(got, want, strict=True):
        assert other.abs().max() > 1e-4
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4 * float(other.abs().max()))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("count", [0, 9])
def test_nobody_has_a_gradient(count, device):
    """No rows, or no gradient in any of them: zeros."""
    made, _ = pair(device=device)
    gaussians, cotangent = rows(count, 2, device)
    _, got = gradients(made, gaussians, 0 * cotangent, [0, 1])
    assert all(torch.equal(one, torch.zeros_like(one)) for one in got)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("value", [torch.inf, torch.nan])
def test_a_gradient_that_is_not_finite_is_not_lost(value, device):
    """The step is not sound, though all other rows have none."""
    made, _ = pair(device=device)
    gaussians, cotangent = rows(30, 2, device)
    cotangent *= 0
    cotangent[1, 4, 2] = value
    assert not torch.nn.utils.get_total_norm(
        gradients(made, gaussians, cotangent, [0, 1])[1]
    ).isfinite()


@ON_HOPPER
@pytest.mark.parametrize("share", [0.0, 0.6, 0.98])
@pytest.mark.parametrize("count", [2_000, 20_289, 20_480])
def test_many_rows(count, share):
    """On a GPU: the gradients of torch's products, some units at rest in one of both only,
    twice the same bits.
    """
    short, plain = pair(FULL, "cuda")
    gaussians, cotangent = rows(count, 3, "cuda")
    cotangent = hidden(cotangent.view(-1, 3), share, 3).view(3, count, 3)
    _, got = gradients(short, gaussians, cotangent, [0, 1, 3])
    _, again = gradients(short, gaussians, cotangent, [0, 1, 3])
    _, want = gradients(plain, gaussians, cotangent, [0, 1, 3])
    for one, other, twice in zip(got, want, again, strict=True):
        assert torch.equal(one, twice)
        assert float((one - other).norm() / other.norm()) < 0.05


@ON_HOPPER
def test_a_replay_equals_a_call():
    """Nothing asks the host, though the list is made anew."""
    made, _ = pair(device="cuda")
    gaussians, cotangent = rows(20_289, 2, "cuda")
    compare_replay(made, gaussians, hidden(cotangent.view(-1, 3), 0.6, 2).view(2, 20_289, 3))
