"""The studies of a hyperparameter search: every chosen model on every chosen dataset."""

from flows.configuration.settings import Settings
from flows.pipeline.plan import Node
from flows.planning.benchmark import data_plan
from flows.planning.costs import data_sizes
from flows.planning.nodes import model_node
from flows.tuning.space import space_of
from flows.tuning.study import StudySpecification

__all__ = ["study_specifications"]


def study_specifications(settings: Settings) -> list[StudySpecification]:
    """The specifications of the studies, dataset by dataset, in the order of the settings.

    This is not in `flows.tuning`, because the plan of a dataset imports environments and a search
    must not.
    """
    data = {node.tags["dataset"]: node for node in data_plan(settings)}
    sizes = {name: data_sizes(settings.dataset[name]) for name in settings.datasets}

    def specification(dataset: str, model: str) -> StudySpecification:
        def node(config: object) -> Node:
            return model_node(model, config, dataset, data[dataset], sizes[dataset])

        space = space_of(model, settings.dataset[dataset].history)
        start = settings.model_on(dataset, model)
        return StudySpecification(dataset, model, start, space, data[dataset], node)

    return [specification(d, m) for d in settings.datasets for m in settings.tuning.models]
