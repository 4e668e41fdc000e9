"""What a model lacks: residual maps, explainable share, candidate effects and their chance level."""
