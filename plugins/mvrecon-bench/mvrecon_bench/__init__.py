"""What mvrecon's parts cost, how large their errors are, and what they bear: benchmarks and the
stress plan.
"""
