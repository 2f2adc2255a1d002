"""Policies and filters for computers that have neither JAX nor this package."""

from sidestep.bridges.export.files import ALONE, WHAT
from sidestep.bridges.export.jax_export import export_jax
from sidestep.bridges.export.onnx_export import export_onnx

__all__ = ["ALONE", "WHAT", "export_jax", "export_onnx"]
