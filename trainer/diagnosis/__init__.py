"""What a model lacks: screening, ranking, verdicts, explanations, and where the error is."""
