from rendered_truth import benchmarks

__all__ = ["benchmarks"]
