"""What libraries write that is of no use to a user."""

import logging
import warnings


def silence_libraries() -> None:
    """Leave libraries' own lines about devices, seeds and fonts out; their warnings stay.

    Some write while they are imported, so this comes before.
    """
    for library in ("lightning.pytorch", "lightning.fabric", "matplotlib"):
        logging.getLogger(library).setLevel(logging.WARNING)
    # Lightning's own use of torch, of which no user can be rid
    warnings.filterwarnings("ignore", r"`isinstance\(treespec, LeafSpec\)` is deprecated")
    # what is logged are steps, of whatever epoch
    warnings.filterwarnings("ignore", "The number of training batches")
