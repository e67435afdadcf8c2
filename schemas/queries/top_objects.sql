-- The ten objects that are seen from most cells.
-- `objects` is a view of the dataset's data/objects-*.parquet files.
SELECT
    object,
    any_value(object_name) AS object_name,
    count(*) AS cells,
    sum(visible_primitives)::BIGINT AS visible_primitives,
    avg(weight) AS mean_weight
FROM objects
GROUP BY object
ORDER BY cells DESC, object
LIMIT 10;
