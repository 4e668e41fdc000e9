"""What a model lacks: residual maps, explainable share, candidates and their chance level."""
