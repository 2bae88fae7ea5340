"""The benchmarks by name: `bench=<name>` reads its options from `conf/bench/<name>.yaml`."""

from mvrecon.core.registry import Registry

BENCHES = Registry(
    "bench",
    operators="mvrecon_bench.benchmarks.operators:Operators",
    methods="mvrecon_bench.benchmarks.methods:Methods",
    small="mvrecon_bench.benchmarks.small:Small",
    scaling="mvrecon_bench.benchmarks.scaling:Scaling",
    precision="mvrecon_bench.benchmarks.precision:Precision",
    emission="mvrecon_bench.benchmarks.emission:Emission",
    skip="mvrecon_bench.benchmarks.skip:Skip",
)
