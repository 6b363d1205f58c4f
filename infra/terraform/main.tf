# A bucket for clusters of plat, and one role per kind of process with the permissions that it needs (module policies).
#
#     module "plat" {
#       source            = ".../infra/terraform"
#       bucket            = "my-cities"
#       oidc_provider_arn = module.eks.oidc_provider_arn
#     }

module "policies" {
  source            = "./policies"
  bucket            = var.bucket
  prefix            = var.prefix
  oidc_provider_arn = var.oidc_provider_arn
  namespace         = var.namespace
}

resource "aws_s3_bucket" "this" {
  bucket = var.bucket
  tags   = var.tags
}

resource "aws_s3_bucket_public_access_block" "this" {
  bucket                  = aws_s3_bucket.this.id
  block_public_acls       = true
  block_public_policy     = true
  ignore_public_acls      = true
  restrict_public_buckets = true
}

resource "aws_s3_bucket_ownership_controls" "this" {
  bucket = aws_s3_bucket.this.id
  rule {
    object_ownership = "BucketOwnerEnforced"
  }
}

resource "aws_s3_bucket_server_side_encryption_configuration" "this" {
  bucket = aws_s3_bucket.this.id
  rule {
    apply_server_side_encryption_by_default {
      sse_algorithm = "AES256"
    }
  }
}

# Artefacts never expire by age, as a job may use an older job's results. `plat forget` deletes unreferenced ones.
resource "aws_s3_bucket_lifecycle_configuration" "this" {
  bucket = aws_s3_bucket.this.id
  rule {
    id     = "uploads-that-were-cut-short"
    status = "Enabled"
    filter {}
    abort_incomplete_multipart_upload {
      days_after_initiation = 1
    }
  }
}

resource "aws_s3_bucket_policy" "this" {
  bucket     = aws_s3_bucket.this.id
  policy     = module.policies.bucket
  depends_on = [aws_s3_bucket_public_access_block.this]
}

resource "aws_iam_role" "this" {
  for_each           = module.policies.roles
  name               = "${var.bucket}-${var.prefix}-${each.key}"
  assume_role_policy = each.value.trust
  tags               = var.tags
}

resource "aws_iam_role_policy" "this" {
  for_each = module.policies.roles
  name     = "store"
  role     = aws_iam_role.this[each.key].id
  policy   = each.value.access
}
