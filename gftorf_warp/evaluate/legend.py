"""What the terms of a report mean, as HTML."""

from ..data.steps import EDGE_PX, STEP_M
from ..data.truth import MOVING_M
from ..recon.residuals import CHI_SQUARE_MAX, MODEL_ERROR

TO_READ = f"""
<dl>
<dt>distance</dt><dd>Length from the camera to the surface along the ray of a pixel, in metres. It
is not the z-depth.</dd>
<dt>closed form</dt><dd>The distance that a camera computes: raw quads give a phase, the phase a
distance; several modulation frequencies together determine the number of whole turns. Quads are
taken one after the other, so moving objects get false distances.</dd>
<dt>temporal</dt><dd>What averaging over time makes of the closed form: the least that a
reconstruction must beat. Mean and median of all quartets mean something where nothing moves
(<em>static throughout</em>: the true distance never changes by more than {MOVING_M} m); the row
<em>temporal</em> takes the mean of the quartets that agree with their pixel's median, and the
closed form in all others. They need a resting camera.</dd>
<dt>d</dt><dd>Mean distance of the reconstructed Gaussians at the time of one raw frame. It is not
divided by opacity: where opacity is below one, the missing part counts as error.</dd>
<dt>median</dt><dd>Distance at which half of the light is stopped, 0 where more than half passes. At
an outline it is one of the two surfaces, where the mean is between them.</dd>
<dt>d_ToF</dt><dd>Quads rendered at the time of one raw frame, decoded like the closed form, within
the unambiguous range: c / 2f, or that of all frequencies together.</dd>
<dt>moving pixels</dt><dd>Pixels whose true distance changes by more than {MOVING_M} m within their
quartet: mostly outlines of moving objects, and whole objects that move fast in depth.</dd>
<dt>edge, interior</dt><dd>Pixels within {EDGE_PX} px of a step of the true distance, and all
others. At a step, neighbouring pixels differ by more than {STEP_M} m from each other and from the
continuation of the surface. Interior pixels are divided by the slope of the true distance.</dd>
<dt>errors</dt><dd>Mean squared error in square metres times 100, then its root in centimetres.
<em>All pixels</em> is the mean over frames of each frame's mean; <em>moving</em> and
<em>static</em> pool the pixels of all frames. The closed form of a quartet is compared with the
truth of each of its raw frames.</dd>
<dt>quad PSNR</dt><dd>Rendered against measured quads, at the phase shift of each raw frame. It
needs no ground truth and is bounded by the noise of the measurement.</dd>
<dt>chi-square</dt><dd>Mean over the raw frames of a quartet of (rendered - measured)&sup2; over
the variance of the noise, which is estimated from the recording. It needs no ground truth, and is
one where everything but noise is explained. A pixel is <em>not explained</em> if the mean exceeds
{CHI_SQUARE_MAX:g} after an error of {100 * MODEL_ERROR:g} % of the amplitude was added to the
noise.</dd>
<dt>grey pixels</dt><dd>Unknown truth, not scored.</dd>
</dl>"""
PHASORS_TO_READ = f"""
<p class="soft">This camera delivered phasors. The four raw frames of a quartet are simultaneous, so
each quartet is scored once, and moving pixels are those whose true distance changes by more than
{MOVING_M} m between consecutive phasors.</p>"""
