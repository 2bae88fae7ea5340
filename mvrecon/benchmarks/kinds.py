"""The benchmarks by name: `bench=<name>` takes its options from `conf/bench/<name>.yaml`."""

from mvrecon.registry import Registry

BENCHES = Registry(
    "bench",
    operators="mvrecon.benchmarks.operators:Operators",
    scaling="mvrecon.benchmarks.scaling:Scaling",
    precision="mvrecon.benchmarks.precision:Precision",
    skip="mvrecon.benchmarks.skip:Skip",
)
