"""An exported policy as a model of MLflow; this file is stored with each such model.

MLflow runs it wherever the model is loaded, so it needs `numpy`, `onnxruntime` and `mlflow` and
nothing of the project that made it. Nothing is pickled.
"""

import json

import mlflow
import numpy as np
import onnxruntime


class ServedPolicy(mlflow.pyfunc.PythonModel):
    """Acts as the file `policy.onnx` beside it, whose card says what goes in and what comes out."""

    # Each of these models has a signature; MLflow asks for type hints to guess one from.
    _skip_type_hint_validation = True

    def load_context(self, context):
        """Open the file.

        Args:
            context: MLflow's, with the path of the file.
        """
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(
            context.artifacts["policy"], options, providers=["CPUExecutionProvider"]
        )
        self._card = json.loads(self._session.get_modelmeta().custom_metadata_map["card.json"])
        self._generator = np.random.default_rng()

    def predict(self, context, model_input, params=None):
        """Choose actions.

        Args:
            context: MLflow's.
            model_input: `[B, H, F]` raw frames, the newest first.
            params: `proximity` for policies that take it; `seed` for those that choose among
                candidates, which draw new ones at every call without it.

        Returns:
            `[B, A]` in the units of the plant.

        Raises:
            ValueError: A frame holds no finite number, or the proximity is outside of [0, 1].
        """
        params = params or {}
        history = np.asarray(model_input, np.float32)
        wrong = np.argwhere(~np.isfinite(history))
        if len(wrong):
            feature = self._card["inputs"]["history"]["features"][wrong[0][-1]]
            raise ValueError(f"A frame holds no number for {feature}; the policy needs every one.")
        inputs = {"history": history}
        if "proximity" in self._card["inputs"]:
            proximity = float(params.get("proximity", 0.0))
            if not 0.0 <= proximity <= 1.0:
                raise ValueError(f"proximity={proximity} must lie in [0, 1].")
            inputs["proximity"] = np.full(len(history), proximity, np.float32)
        if "noise" in self._card["inputs"]:
            seed = params.get("seed")
            generator = self._generator if seed is None else np.random.default_rng(seed)
            shape = (len(history), *self._card["inputs"]["noise"]["shape"][1:])
            inputs["noise"] = generator.standard_normal(shape, np.float32)
        return self._session.run(None, inputs)[0]


mlflow.models.set_model(ServedPolicy())
