"""The operator of a case: another one only where the operator has something of a case's own."""

import torch

from mvrecon.operators.operator import PerSample, Wrapped
from tests.methods.learned.rig import small_projector


class Twice(Wrapped):
    """An operator that counts twice in a case named "twice"."""

    def for_case(self, case):
        return 2.0 * self.A if case.get("name") == ["twice"] else self.A


def test_only_an_operator_with_something_of_a_case_gives_another_operator():
    """Of a plain operator, a scaled one and a batch of operators none does."""
    A, x = small_projector(), torch.rand(1, 1, 12, 12, 12)
    for plain in (A, 2.0 * A, A.T, PerSample([A, A])):
        assert plain.for_case({"name": ["twice"]}) is plain
    assert Twice(A).for_case({}) is A
    torch.testing.assert_close(Twice(A).for_case({"name": ["twice"]})(x), 2 * A(x))
