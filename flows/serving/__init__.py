"""Policies as models of MLflow, which serve without this project."""
