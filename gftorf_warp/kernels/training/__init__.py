"""A training step beside its renderings. In launch order:

noise              random backgrounds by a counter-based generator
image_similarity   pixel and structural-similarity loss of an image, and its gradient
optical_flow       loss of the rendered optical flow, and its gradient
step_end           whether a step counts, running sums, densification statistics
adam               Adam for all tensors in one launch
ordered_sums       sums in a fixed order, launched behind each of these
"""
