"""Settings of all training tests."""

try:
    import torch
except ImportError:  # they skip themselves
    pass
else:
    # Two threads that wait for each other are many times slower than one where other tests keep the cores busy.
    torch.set_num_threads(1)
