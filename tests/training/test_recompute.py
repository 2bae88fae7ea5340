"""Activation checkpointing: the same gradients from less memory."""

import torch
from torch.autograd.graph import saved_tensors_hooks

from mvrecon.methods.learned.unet import PlainUNet
from mvrecon.training.callbacks import Recompute


def gradients(model, x):
    """Gradients of a sum of squares by name, and the bytes that were stored for them."""
    stored = {}

    def pack(tensor):
        stored[tensor.data_ptr()] = tensor.nbytes
        return tensor

    with saved_tensors_hooks(pack, lambda tensor: tensor):
        loss = model(x).square().sum()
    loss.backward()
    return {name: p.grad.clone() for name, p in model.named_parameters()}, sum(stored.values())


def test_recomputed_activations_give_the_same_gradients_from_less_memory():
    torch.manual_seed(0)
    network, x = PlainUNet(3, 1, 1, (4, 8)), torch.randn(1, 1, 12, 12, 12)
    whole, stored = gradients(network, x)
    network.zero_grad()

    class Module:
        method = network

    Recompute().setup(None, Module(), "fit")
    again, less = gradients(network, x)
    assert all(torch.equal(whole[name], again[name]) for name in whole)
    assert less < 0.6 * stored
