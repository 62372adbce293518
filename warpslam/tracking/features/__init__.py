"""Sparse features: a second, independent witness of the camera's motion beside registration of whole images."""
