"""The agent files of the package; ``agent.loading.SHIPPED`` lists their names."""
