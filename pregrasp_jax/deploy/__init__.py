"""From an RGB-D image to a push of a real robot, with numpy and onnxruntime: neither JAX nor MuJoCo is imported."""
