"""The commands of `mi-ntf`: one dataclass each, whose fields are the options and whose `run` does the work.

`run` imports what the command needs, so that `info` loads no renderer and `render` no PyTorch.
"""
