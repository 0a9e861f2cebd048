"""Studies, benchmarks and published weights."""
