"""The live page as a folder of files: what its server computes is WebAssembly in the browser."""

from sidestep.bridges.static_page.files import write_page

__all__ = ["write_page"]
