"""One rendering and its adjoint. In launch order:

    project              Gaussians to splats: projection, reflectivity, light, depth key
    depth_bins           splats in depth order by counting, without a sort
    tiles                which tiles a splat reaches: counts, keys, sorted lists
    tile_bitmask         tile lists out of a bit matrix [tile, splat], without a sort
    deterministic_sums   one gradient record per (tile, splat) pair, summed in a fixed order
    composite            front to back: T-weighted channels and distance, T^2-weighted light
    planes_to_images     planes in tile order to row-major images, and the adjoint
    composite_backward   adjoint of the compositor, back to front

Read by these kernels: ``splat`` (the record of a projected Gaussian), ``splat_distance`` (distances
that differ from pixel to pixel of a splat), ``simd`` (arithmetic on the
pixels of a thread), ``shared_batches`` (records staged in shared memory), ``list_segments`` (tile
lists cut into segments for the adjoint).
"""
