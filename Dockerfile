# docker build -t rack . && docker run --rm --shm-size 1g rack
# docker run --rm --shm-size 1g rack make test
FROM python:3.11-slim
RUN apt-get update && apt-get install --yes --no-install-recommends make
WORKDIR /rack
COPY . .
RUN make .venv/installed
CMD ["make", "run"]
