"""The motion network in half precision on Hopper's tensor cores. In launch order:

encoding              sines and cosines of the positions
perceptron            parameters packed; forward and backward pass, one launch each
gradient_rows         list of the rows that have a gradient
gradient_scaling      loss scaling of the output gradients before they are rounded to half precision
weight_gradients      weight gradients of the hidden layers over the listed rows
parameter_gradients   weight gradient of the head, and all parameter gradients out of partial sums
wgmma                 C++ of the forward and backward pass; no kernel of its own
"""
