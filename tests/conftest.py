"""What all tests need: torch as the scripts set it, so that results are the same bit for bit in any shell."""

import torch

torch.set_num_threads(1)
torch.set_flush_denormal(True)
