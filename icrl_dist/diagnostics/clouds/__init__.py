"""Schemas of ``node_config``: the keys and types that each cloud accepts for a node.

``aws.json``: the members of EC2's RunInstances, from the service description of botocore 1.44.8, with
``SubnetIds`` in place of the members that Ray sets itself.  ``gcp.json``: Compute Engine's Instance,
from the discovery document of google-api-python-client 2.202.0, without the fields that only the
service writes.  Both are three levels deep; the content of a ``map`` is not checked.
"""
