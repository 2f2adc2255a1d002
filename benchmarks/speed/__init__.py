"""How fast is it: ours and the peers measured in one run, and how cost grows.

Each section is a module with `cases(quick)`, the work to be measured, one entry per child process, and
`run(settings)`, which does it there. Peers are imported inside the functions that time them, never here.
"""
