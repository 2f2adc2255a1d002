"""Policies and filters for computers that have neither JAX nor this package."""

from sidestep.bridges.export.c_export import export_c
from sidestep.bridges.export.files import ALONE, WHAT
from sidestep.bridges.export.jax_export import export_jax
from sidestep.bridges.export.onnx_export import export_onnx
from sidestep.bridges.export.program import NotTranslatable

__all__ = ["ALONE", "WHAT", "NotTranslatable", "export_c", "export_jax", "export_onnx"]
