"""Methods: what moves the Gaussians (or rays) of a scene; found by `neeco.scene.method_registry`."""
