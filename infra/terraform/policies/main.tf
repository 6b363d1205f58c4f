# Permissions in the bucket by role, as plain values. This module needs no provider, so that its tests run anywhere.
#
#                 artefacts/   names/leader/   names/results/, names/checkpoints/   names/ingest/   state/
#   coordinator   all          all             all                                  all             all       (plat forget deletes)
#   worker        read, add    read            read, write                          read            -
#   client        read, add    read            -                                    read, write     -
#
# So a compromised worker can waste work, which the artefacts' hashes reveal, but cannot change the jobs' state or the leader's lease.

locals {
  partition = split(":", var.oidc_provider_arn)[1]
  issuer    = split(":oidc-provider/", var.oidc_provider_arn)[1]
  arn       = "arn:${local.partition}:s3:::${var.bucket}"

  # By role: folders that it reads, writes and deletes from.
  access = {
    coordinator = { reads = ["*"], writes = ["*"], deletes = ["*"] }
    worker = {
      reads   = ["artefacts/*", "names/*"]
      writes  = ["artefacts/*", "names/results/*", "names/checkpoints/*"]
      deletes = []
    }
    client = {
      reads   = ["artefacts/*", "names/*"]
      writes  = ["artefacts/*", "names/ingest/*"]
      deletes = []
    }
  }

  statements = {
    for role, may in local.access : role => concat(
      [
        for action, folders in { GetObject = may.reads, PutObject = may.writes, DeleteObject = may.deletes } : {
          Effect                           = "Allow"
          Action                           = ["s3:${action}"]
          Resource                         = [for folder in folders : "${local.arn}/${var.prefix}/${folder}"]
        } if length(folders) > 0
      ],
      # Without this permission a missing object is reported as a forbidden one.
      [{
        Effect    = "Allow"
        Action    = ["s3:ListBucket"]
        Resource  = [local.arn]
        Condition = { StringLike = { "s3:prefix" = ["${var.prefix}/*"] } }
      }],
    )
  }
}

output "bucket" {
  description = "The bucket's policy (JSON): refuses requests without TLS."
  value = jsonencode({
    Version = "2012-10-17"
    Statement = [{
      Sid       = "EncryptedOnTheWay"
      Effect    = "Deny"
      Principal = "*"
      Action    = ["s3:*"]
      Resource  = [local.arn, "${local.arn}/*"]
      Condition = { Bool = { "aws:SecureTransport" = "false" } }
    }]
  })
}

output "roles" {
  description = "By role: who may assume it (trust) and its permissions (access), both JSON."
  value = {
    for role, statements in local.statements : role => {
      access = jsonencode({ Version = "2012-10-17", Statement = statements })
      trust = jsonencode({
        Version = "2012-10-17"
        Statement = [{
          Effect    = "Allow"
          Action    = "sts:AssumeRoleWithWebIdentity"
          Principal = { Federated = var.oidc_provider_arn }
          Condition = {
            StringEquals = {
              "${local.issuer}:aud" = "sts.amazonaws.com"
              "${local.issuer}:sub" = "system:serviceaccount:${var.namespace}:${role}"
            }
          }
        }]
      })
    }
  }
}
