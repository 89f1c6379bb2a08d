"""Methods: deformations of a scene's Gaussians (or rays), registered by `neeco.scene.method_registry`."""
