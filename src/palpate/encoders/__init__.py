"""The encoders (vision, text, touch): loading, contrastive training, embedding with a cache, probes. Imports torch."""
