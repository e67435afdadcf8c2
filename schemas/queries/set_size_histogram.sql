-- How many cells have sets of which size, in powers of two.
-- `cells` is a view of the dataset's data/cells-*.parquet files; of each cell, the row of all states.
WITH sized AS (
    SELECT
        primitives,
        CASE WHEN primitives = 0 THEN 0 ELSE 1 + floor(log2(primitives))::INTEGER END AS bucket
    FROM cells
    WHERE first_state = 0 AND last_state = (SELECT max(last_state) FROM cells)
)
SELECT
    CASE WHEN bucket = 0 THEN 0 ELSE (2 ** (bucket - 1))::BIGINT END AS primitives_from,
    CASE WHEN bucket = 0 THEN 1 ELSE (2 ** bucket)::BIGINT END AS primitives_below,
    count(*) AS cells
FROM sized
GROUP BY bucket
ORDER BY bucket;
