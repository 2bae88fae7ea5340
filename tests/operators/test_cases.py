"""The operator of a case: another one only where the operator has something of a case's own."""

import torch

from mvrecon.operators.cases import operator_for
from mvrecon.operators.operator import PerSample
from tests.methods.learned.rig import small_projector


class Twice(torch.nn.Module):
    """An operator that counts twice in a case named "twice"."""

    def __init__(self, A):
        super().__init__()
        self.A = A

    def for_case(self, case):
        return 2.0 * self.A if case.get("name") == ["twice"] else self.A


def test_only_an_operator_with_something_of_a_case_gives_another_operator():
    """Of a plain operator, a scaled one and a batch of operators none does."""
    A, x = small_projector(), torch.rand(1, 1, 12, 12, 12)
    for plain in (A, 2.0 * A, A.T, PerSample([A, A])):
        assert operator_for(plain, {"name": ["twice"]}) is plain
    assert operator_for(Twice(A), {}) is A
    torch.testing.assert_close(operator_for(Twice(A), {"name": ["twice"]})(x), 2 * A(x))
