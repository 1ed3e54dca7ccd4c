"""Open a sequence, list the sources of its values, and decode distance in closed form,
which motion breaks.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from gftorf_warp import Sequence, simulate
from gftorf_warp.data.check import check
from gftorf_warp.data.decode import closed_form_distance


def main(path: Path) -> float:
    """Return the largest closed-form error [m] in the first quartet of a simulated sequence."""
    print(check(path))  # what `gftorf check` prints

    sequence = Sequence.open(path)
    for name, source in sequence.sources.items():
        print(f"{name}: {source}")

    # from raw frames 0..3, as if they were simultaneous
    decoded = closed_form_distance(sequence, 0)
    error = np.abs(decoded - sequence.truth().distance[0])
    y, x = np.unravel_index(np.nanargmax(error), error.shape)
    print(
        f"median error {1e3 * np.nanmedian(error):.1f} mm, largest {error[y, x]:.2f} m at "
        f"pixel [{y}, {x}]"
    )
    return float(error[y, x])


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as temporary:
            main(simulate("sliding", Path(temporary) / "sliding", frames=4, size=(48, 36)))
