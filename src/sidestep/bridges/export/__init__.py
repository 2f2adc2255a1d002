"""Policies and filters for computers that have neither JAX nor this package."""

from sidestep.bridges.export.c_export import export_c
from sidestep.bridges.export.files import ALONE, WHAT
from sidestep.bridges.export.jax_export import export_jax
from sidestep.bridges.export.onnx_export import export_onnx
from sidestep.bridges.export.program import NotTranslatable
from sidestep.bridges.export.wasm_code import WasmLibrary

__all__ = ["ALONE", "WHAT", "NotTranslatable", "WasmLibrary", "export_c", "export_jax", "export_onnx"]
