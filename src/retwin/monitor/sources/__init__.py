"""Where samples come from, besides those that programs post: folders, MQTT brokers, OPC UA."""
