"""Tensors in, unreduced maps out."""
