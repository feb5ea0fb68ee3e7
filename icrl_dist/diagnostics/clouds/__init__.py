"""What a node of a cloud may be asked for: keys and types, as the clouds publish them.

``aws.json``: the members of EC2's RunInstances, from botocore 1.44.8's service description, with
``SubnetIds`` in place of what Ray fills in itself; ``gcp.json``: Compute Engine's Instance, from
google-api-python-client 2.202.0's discovery document, without what only the service writes.
Three levels deep; ``map`` is looked into no further.
"""
